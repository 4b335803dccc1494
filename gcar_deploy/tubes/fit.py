"""The default refiner: settle the points, build the tree, fit it, cut and grow, look again.

Last of all it states sigma.
"""

from __future__ import annotations

import dataclasses
import heapq
from collections.abc import Callable, Sequence

import numpy as np

from gcar_deploy.config import TubeOptions
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.covariance import worst_sigma
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.tree.centerline import build_tree, usable_points
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.choice import (
    MIN_SHARE,
    CloseCall,
    close_calls,
    kept_tree,
    reinstated,
    weigh_pieces,
)
from gcar_deploy.tubes.gauss_newton import (
    Progress,
    fit_level,
    footprints,
    rescaled,
)
from gcar_deploy.tubes.hessian import seen_by
from gcar_deploy.tubes.missed import Proposal, Told, looked_at, missed_lines, proposal
from gcar_deploy.tubes.model import Footprint, Tubes, tubes_of
from gcar_deploy.tubes.prior import TAPER_PIXEL_MM, Prior, make_prior
from gcar_deploy.tubes.radius_refit import refit_radii
from gcar_deploy.tubes.settle import settled
from gcar_deploy.tubes.support import grown_tree, seen_share, supported_tree, unexplained
from gcar_deploy.tubes.targets import Target, make_targets
from gcar_deploy.tubes.uncertainty import spread
from gcar_deploy.types import Array, Scalars

#: a vessel that was missed is kept where it lowers the objective by this share ...
EARNED = 0.005
#: ... and, where paths are estimates and a line may be background, by so much per mm of it
EARNED_PER_MM = 0.3


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TubeFit:
    """Outcome of the tube refiner.

    Attributes
    ----------
    tree : Tree with sigma per point; empty where nothing could be built
    centers : CenterPoints the tree was built from
    scatter_mm : float, estimated scatter of the starting points (0 on a lattice)
    contrast : tuple of float, per view, factor of the picture's path on the model's
    progress : Progress
    model_mm : per view (rows, cols) path of the tubes at the picture's own pixels; empty where
        the fit ended before that level
    close_calls : pieces that were kept or dropped by a hair
    """

    tree: Tree
    centers: CenterPoints
    scatter_mm: float
    contrast: tuple[float, ...]
    progress: Progress
    model_mm: tuple[Array, ...] = ()
    close_calls: tuple[CloseCall, ...] = ()


def fit_tubes(
    centers: CenterPoints,
    views: Sequence[VesselImage],
    options: TubeOptions,
    should_stop: Callable[[], bool] | None = None,
    evidence: CenterPoints | None = None,
) -> TubeFit:
    """Fit a tube tree to the pictures from starting points.

    Parameters
    ----------
    centers : CenterPoints
    views : sequence of VesselImage, one or more
    options : TubeOptions
    should_stop : callable, asked before each step; True ends the fit with the best so far
    evidence : what the predictor said of each candidate before any was chosen; without it no vessel
        is looked for that the points miss
    """
    progress = Progress()
    settled_centers, scatter = settled(
        usable_points(centers), [(view.carm, view.path_mm) for view in views]
    )
    if should_stop is not None:
        # Whoever cancelled raises here; a deadline is heeded by the first step.
        should_stop()
    tree = build_tree(settled_centers)
    fit = TubeFit(
        tree=tree,
        centers=settled_centers,
        scatter_mm=scatter,
        contrast=(1.0,) * len(views),
        progress=progress,
    )
    if not tree.branches:
        return fit
    return _fitted(fit, views, _Run(options, progress, should_stop, evidence))


@dataclasses.dataclass(frozen=True, eq=False)
class _Run:
    """What every stage of one fit shares."""

    options: TubeOptions
    progress: Progress
    should_stop: Callable[[], bool] | None
    evidence: CenterPoints | None

    def fit(self, tree: Tree, targets: list[Target], steps: int) -> _State:
        """Fit from where the tree is now."""
        tubes, prior = _start(tree, self.options, _pixel_mm(targets))
        prints: list[Footprint] = []
        if tree.branches:
            tubes, prints = fit_level(
                tubes, targets, prior, self.options, steps, self.progress, self.should_stop
            )
        return _State(tree_of(tubes, tree), tubes, prior, prints)


@dataclasses.dataclass(frozen=True, eq=False)
class _State:
    """A tree, its tubes, the prior round its start, and where the tubes fall in each view."""

    tree: Tree
    tubes: Tubes
    prior: Prior
    prints: list[Footprint]


def _fitted(start: TubeFit, views: Sequence[VesselImage], run: _Run) -> TubeFit:
    options, progress = run.options, run.progress
    targets: list[Target] = []
    start_radius = start.tree.radii()
    now = _State(start.tree, *_start(start.tree, options), [])
    for number, (level, steps) in enumerate(zip(options.levels_mm, options.steps, strict=True)):
        if number and (progress.stopped or progress.failed):
            break
        targets = _contrasts(make_targets(views, level, options), targets)
        prior = now.prior.at_pixel(_pixel_mm(targets), options)
        tubes, prints = fit_level(
            now.tubes, targets, prior, options, steps, progress, run.should_stop
        )
        now = _State(tree_of(tubes, now.tree), tubes, prior, prints)
        if number or len(options.levels_mm) == 1:
            continue
        if len(targets) > 1:
            now, calls = _chosen(now, start_radius, targets, run)
            start = dataclasses.replace(start, close_calls=calls)
        if now.tree.branches:
            now = run.fit(_supported(now, targets), targets, steps // 2)
        if not now.tree.branches:
            break
    contrast = tuple(target.contrast for target in targets)
    if not now.tree.branches:
        return dataclasses.replace(start, tree=now.tree, contrast=contrast)
    if not (options.levels_mm[-1] or progress.stopped or progress.failed):
        now = _with_missed(now, views, targets, run)
        now = _with_refitted_radii(now, targets, options)
    targets = rescaled(targets, now.prints)
    own = all(t.path_mm.shape == v.path_mm.shape for t, v in zip(targets, views, strict=True))
    return dataclasses.replace(
        start,
        tree=with_sigma(now, targets, options),
        contrast=tuple(target.contrast for target in targets),
        model_mm=tuple(
            seen.image(target.path_mm.shape)
            for target, seen in zip(targets, now.prints, strict=True)
        )
        if own and not options.levels_mm[-1]
        else (),
    )


def _with_missed(
    now: _State, views: Sequence[VesselImage], targets: list[Target], run: _Run
) -> _State:
    """Add the lines that no tube explains, the likeliest first, each where it earns its place."""
    if run.evidence is None or len(views) < 2:
        return now
    looks = looked_at(views, rescaled(targets, now.prints), now.prints)
    lines = missed_lines(looks)
    if not lines:
        return now
    told = Told.by(run.evidence)
    # Costs are of the tree as it was when they were found: of a later one they are asked once more.
    queue: list[tuple[float, int, Proposal | None, _State | None]] = [
        (-np.inf, number, None, None) for number in range(len(lines))
    ]
    least: float | None = None
    while queue:
        _, number, found, of = heapq.heappop(queue)
        if found is None or of is not now:
            found = proposal(lines[number], looks, now.tree, told)
            if found is not None:
                heapq.heappush(queue, (found.cost, number, found, now))
            continue
        if least is None:
            # What it must beat has had as many steps, from as near a start.
            least = _tried(now.tree, targets, run)[1].losses[-1]
        trial, progress = _tried(found.added(now.tree), targets, run)
        if progress.stopped:
            run.progress.stopped = True
            break
        price = EARNED * least
        if not all(target.calibrated for target in targets):
            price = max(price, EARNED_PER_MM * (trial.tree.length_mm - now.tree.length_mm))
        if progress.losses[-1] < least - price:
            now, least = trial, progress.losses[-1]
            run.progress.follow(progress)
            looks = looked_at(views, rescaled(targets, now.prints), now.prints)
    return now


def _tried(tree: Tree, targets: list[Target], run: _Run) -> tuple[_State, Progress]:
    """Fit at the last level without a trace in what the run has done so far."""
    aside = dataclasses.replace(run, progress=Progress())
    return aside.fit(tree, targets, run.options.steps[-1]), aside.progress


def _with_refitted_radii(now: _State, targets: list[Target], options: TubeOptions) -> _State:
    """Refit the radii where the pixels are fine enough to show a narrow core."""
    if _pixel_mm(targets) >= TAPER_PIXEL_MM:
        return now
    tubes, prints = refit_radii(now.tubes, targets, now.prints, options)
    return _State(tree_of(tubes, now.tree), tubes, now.prior, prints)


def _pixel_mm(targets: Sequence[Target]) -> float:
    """Coarsest pixel at the isocentre, mm."""
    return max(target.pixel_mm for target in targets)


def _start(tree: Tree, options: TubeOptions, pixel_mm: float = np.inf) -> tuple[Tubes, Prior]:
    tubes = tubes_of(tree)
    trust = np.concatenate([np.zeros(0), *(branch.confidence for branch in tree.branches)])
    return tubes, make_prior(tubes, trust, options, pixel_mm)


def _contrasts(targets: list[Target], before: list[Target]) -> list[Target]:
    if not before:
        return targets
    return [
        dataclasses.replace(new, contrast=old.contrast)
        for new, old in zip(targets, before, strict=True)
    ]


def _chosen(
    now: _State, start_radius: Scalars, targets: list[Target], run: _Run
) -> tuple[_State, tuple[CloseCall, ...]]:
    """Drop ghosts, fit the rest, and take back what every view then misses."""
    options, tree = run.options, now.tree
    targets = rescaled(targets, now.prints)
    pieces = weigh_pieces(tree, now.tubes, start_radius, targets)
    if (pieces.share >= MIN_SHARE).all():
        return now, close_calls(tree, pieces)
    steps = options.steps[0] // 2
    kept = run.fit(kept_tree(tree, pieces), targets, steps)
    prints = kept.prints or footprints(kept.tubes, targets)
    left = unexplained(targets, prints)
    back = reinstated(tree, pieces, start_radius, targets, left)
    if not np.array_equal(back.share, pieces.share):
        kept = run.fit(kept_tree(tree, back), targets, steps)
    return kept, close_calls(tree, back)


def _supported(now: _State, targets: list[Target]) -> Tree:
    """Cut what the pictures do not show, then grow along what the tree does not explain."""
    targets = rescaled(targets, now.prints)
    share = seen_share(now.tubes, targets, now.prints)
    tree = supported_tree(now.tree, now.tubes, share)
    if not tree.branches:
        return tree
    left = unexplained(targets, footprints(tubes_of(tree), targets))
    return grown_tree(tree, targets, left)


def tree_of(tubes: Tubes, tree: Tree) -> Tree:
    """Return ``tree`` with the positions and radii of ``tubes``, which was made from it."""
    points, radii = tubes.points_mm, tubes.radius_mm
    branches = []
    for k, branch in enumerate(tree.branches):
        own = tubes.point_branch == k
        branches.append(dataclasses.replace(branch, points_mm=points[own], radius_mm=radii[own]))
    nodes = tubes.positions_mm[: len(tree.nodes_mm)]
    return dataclasses.replace(tree, nodes_mm=nodes, branches=tuple(branches))


def with_sigma(now: _State, targets: list[Target], options: TubeOptions) -> Tree:
    """Return the tree with covariance and sigma per point."""
    tree, tubes = now.tree, now.tubes
    views = [
        seen_by(tubes, target, seen, options)
        for target, seen in zip(targets, now.prints, strict=True)
    ]
    tangents = np.concatenate([branch.tangents for branch in tree.branches])
    parts = spread(tubes, tangents, views, now.prior)
    covariance = np.stack([parts.fit, parts.geometry], axis=1)
    sigma = worst_sigma(parts.fit + parts.geometry)
    branches = []
    for k, branch in enumerate(tree.branches):
        own = tubes.point_branch == k
        branches.append(
            dataclasses.replace(branch, sigma_mm=sigma[own], covariance_mm2=covariance[own])
        )
    return dataclasses.replace(tree, branches=tuple(branches))
