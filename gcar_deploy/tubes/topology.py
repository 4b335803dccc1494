"""Which vessels hang where: lines that no tube explains, and parts that hang on nothing.

Two views leave open which line of one is which of the other: a wrong choice explains both pictures
nearly as well, but its vessel then seldom meets the tree that it leaves in both. So parts of the
tree that hang on nothing are given up on trial, and their lines proposed anew, each from the tree.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.tree.edit import kept_branches
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.gauss_newton import Progress, rescaled
from gcar_deploy.tubes.missed import looked_at, missed_lines
from gcar_deploy.tubes.proposal import Proposal, Told, proposal
from gcar_deploy.tubes.run import Run, State
from gcar_deploy.tubes.targets import Target
from gcar_deploy.types import Array, Scalars

#: a vessel that was missed is kept where it lowers the objective by this share ...
EARNED = 0.005
#: ... and, where paths are estimates and a line may be background, by so much per mm of it
EARNED_PER_MM = 0.3
#: parts that hang on nothing are asked for from so many mm on; where paths are estimates, each mm
#: of them costs as much of the objective. On generated pairs 0.1 to 0.2 choose alike
LEAST_LOOSE_MM, LOOSE_PER_MM = 8.0, 0.2


@dataclasses.dataclass(frozen=True, eq=False)
class Trial:
    """A tree fitted on trial.

    Attributes
    ----------
    state : State
    progress : Progress of the trial's last fit
    """

    state: State
    progress: Progress

    @property
    def loss(self) -> float:
        """Return the objective at the end of the fit."""
        return self.progress.losses[-1]


def settled_topology(
    now: State, views: Sequence[VesselImage], targets: list[Target], run: Run
) -> State:
    """Add what was missed, then hang on the tree what hangs on nothing, where the pictures allow.

    Parameters
    ----------
    now : State at the last level
    views, targets : one each per view
    run : Run; its progress follows what is taken. Without evidence nothing is done
    """
    if run.evidence is None or len(views) < 2 or not _missed_or_loose(now, views, targets):
        return now
    told = Told.by(run.evidence)
    # What has to be beaten has had as many steps, from as near a start.
    given = Trial(*run.tried(now.tree, targets))
    if given.progress.stopped:
        run.progress.stopped = True
        return now
    best = _with_missed(given, views, targets, run, told)
    best = _hung(best, views, targets, run, told)
    if best is given:
        return now
    run.progress.follow(best.progress)
    return best.state


def _missed_or_loose(now: State, views: Sequence[VesselImage], targets: list[Target]) -> bool:
    """Whether lines are missed or parts hang on nothing."""
    looks = looked_at(views, rescaled(targets, now.prints), now.prints)
    return loose_mm(now.tree) >= LEAST_LOOSE_MM or bool(missed_lines(looks))


def _with_missed(
    now: Trial, views: Sequence[VesselImage], targets: list[Target], run: Run, told: Told
) -> Trial:
    """Add the lines that no tube explains, the likeliest first, each where it earns its place."""
    while not run.progress.stopped:
        better = None
        for found in _proposals(now.state, views, targets, told):
            trial = Trial(*run.tried(found.added(now.state.tree), targets))
            if trial.progress.stopped:
                run.progress.stopped = True
                break
            price = EARNED * now.loss
            if not all(target.calibrated for target in targets):
                longer = trial.state.tree.length_mm - now.state.tree.length_mm
                price = max(price, EARNED_PER_MM * longer)
            if trial.loss < now.loss - price:
                better = trial
                break
        if better is None:
            break
        now = better
    return now


def _proposals(
    now: State, views: Sequence[VesselImage], targets: list[Target], told: Told
) -> list[Proposal]:
    """Return what the lines that no tube explains could be, the likeliest first."""
    looks = looked_at(views, rescaled(targets, now.prints), now.prints)
    found = (proposal(line, looks, now.tree, told) for line in missed_lines(looks))
    return sorted((one for one in found if one is not None), key=lambda one: one.cost)


def _hung(
    given: Trial, views: Sequence[VesselImage], targets: list[Target], run: Run, told: Told
) -> Trial:
    """Propose anew what hangs on nothing; ``given`` where that explains the pictures less well."""
    tree = given.state.tree
    if run.progress.stopped or loose_mm(tree) < LEAST_LOOSE_MM:
        return given
    hanging = Trial(*run.tried(_hanging(tree), targets))
    other = _with_missed(hanging, views, targets, run, told)
    if run.progress.stopped:
        return given
    price = 0.0 if all(target.calibrated for target in targets) else LOOSE_PER_MM
    values = [one.loss + price * loose_mm(one.state.tree) for one in (given, other)]
    return other if values[1] < values[0] else given


def loose_mm(tree: Tree) -> float:
    """Length of all parts of a tree but the longest, mm."""
    lengths = _part_lengths(tree)
    return float(lengths.sum() - lengths.max(initial=0.0))


def _hanging(tree: Tree) -> Tree:
    """Return the tree without its parts of some length that do not hang on the longest one."""
    lengths = _part_lengths(tree)
    kept = (lengths < LEAST_LOOSE_MM) | (np.arange(len(lengths)) == lengths.argmax())
    return kept_branches(tree, kept[_part(tree)])


def _part_lengths(tree: Tree) -> Scalars:
    """Return the length of each connected part, mm."""
    lengths = np.array([branch.length_mm for branch in tree.branches])
    return np.bincount(_part(tree), lengths).astype(np.float64)


def _part(tree: Tree) -> Array:
    """Return the connected part of each branch."""
    part: Array = tree.components()[[branch.start for branch in tree.branches]]
    return part
