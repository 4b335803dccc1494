"""What the stages of one fit share: the state of a tree under fit, and how it is fitted on."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from gcar_deploy.config import TubeOptions
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.gauss_newton import Progress, fit_level
from gcar_deploy.tubes.model import Footprint, Tubes, tubes_of
from gcar_deploy.tubes.prior import Prior, make_prior
from gcar_deploy.tubes.targets import Target


@dataclasses.dataclass(frozen=True, eq=False)
class State:
    """A tree, its tubes, the prior round its start, and where the tubes fall in each view."""

    tree: Tree
    tubes: Tubes
    prior: Prior
    prints: list[Footprint]


@dataclasses.dataclass(frozen=True, eq=False)
class Trial:
    """A tree that was fitted on trial, and how that went."""

    state: State
    progress: Progress

    @property
    def tree(self) -> Tree:
        """Return the fitted tree."""
        return self.state.tree

    @property
    def loss(self) -> float:
        """Return the objective at the end of the fit."""
        return self.progress.losses[-1]


@dataclasses.dataclass(frozen=True, eq=False)
class Run:
    """What every stage of one fit shares."""

    options: TubeOptions
    progress: Progress
    should_stop: Callable[[], bool] | None
    evidence: CenterPoints | None

    def fit(self, tree: Tree, targets: list[Target], steps: int) -> State:
        """Fit from where the tree is now."""
        tubes, prior = started_at(tree, self.options, coarsest_pixel_mm(targets))
        prints: list[Footprint] = []
        if tree.branches:
            tubes, prints = fit_level(
                tubes, targets, prior, self.options, steps, self.progress, self.should_stop
            )
        return State(tree_of(tubes, tree), tubes, prior, prints)

    def tried(self, tree: Tree, targets: list[Target], hopeless: float = np.inf) -> Trial:
        """Fit at the last level; of that the run remembers no more than that it was stopped.

        An objective above ``hopeless`` after one step, or twice that much before, ends the fit:
        further steps gain less than the first.
        """
        own = Progress()

        def in_vain() -> bool:
            return len(own.losses) < 3 and own.losses[-1] > (3 - len(own.losses)) * hopeless

        def stop() -> bool:
            return in_vain() or (self.should_stop is not None and self.should_stop())

        aside = dataclasses.replace(self, progress=own, should_stop=stop)
        state = aside.fit(tree, targets, self.options.steps[-1])
        self.progress.stopped |= own.stopped and not in_vain()
        return Trial(state, own)


def started_at(tree: Tree, options: TubeOptions, pixel_mm: float = np.inf) -> tuple[Tubes, Prior]:
    """Return the tubes of a tree, and the prior round them for pixels of that size."""
    tubes = tubes_of(tree)
    trust = np.concatenate([np.zeros(0), *(branch.confidence for branch in tree.branches)])
    return tubes, make_prior(tubes, trust, options, pixel_mm)


def tree_of(tubes: Tubes, tree: Tree) -> Tree:
    """Return ``tree`` with the positions and radii of ``tubes``, which was made from it."""
    points, radii = tubes.points_mm, tubes.radius_mm
    branches = []
    for k, branch in enumerate(tree.branches):
        own = tubes.point_branch == k
        branches.append(dataclasses.replace(branch, points_mm=points[own], radius_mm=radii[own]))
    nodes = tubes.positions_mm[: len(tree.nodes_mm)]
    return dataclasses.replace(tree, nodes_mm=nodes, branches=tuple(branches))


def coarsest_pixel_mm(targets: Sequence[Target]) -> float:
    """Coarsest pixel at the isocentre, mm."""
    return max(target.pixel_mm for target in targets)
