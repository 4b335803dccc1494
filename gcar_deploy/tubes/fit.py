"""The default refiner: settle the points, build the tree, fit it, cut and grow, look again.

Last of all it states sigma.
"""

from __future__ import annotations

import dataclasses
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
from gcar_deploy.tubes.gaps import joined_in_pictures
from gcar_deploy.tubes.gauss_newton import (
    Progress,
    fit_level,
    footprints,
    rescaled,
)
from gcar_deploy.tubes.hessian import seen_by
from gcar_deploy.tubes.model import tubes_of
from gcar_deploy.tubes.needed import needed_tree
from gcar_deploy.tubes.prior import TAPER_PIXEL_MM
from gcar_deploy.tubes.radius_refit import refit_radii
from gcar_deploy.tubes.run import Run, State, coarsest_pixel_mm, started_at, tree_of
from gcar_deploy.tubes.settle import settled
from gcar_deploy.tubes.support import grown_tree, seen_share, supported_tree, unexplained
from gcar_deploy.tubes.targets import Target, make_targets
from gcar_deploy.tubes.topology import settled_topology
from gcar_deploy.tubes.uncertainty import spread
from gcar_deploy.types import Array, Scalars


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TubeFit:
    """Outcome of the tube refiner.

    Attributes
    ----------
    tree : Tree with sigma per point; empty where nothing could be built
    centers : CenterPoints the tree was built from
    contrast : tuple of float, per view, factor of the picture's path on the model's
    progress : Progress
    model_mm : per view (rows, cols) what the picture's own pixels tell of the tubes; empty where
        the fit ended before that level
    close_calls : pieces that were kept or dropped by a hair
    """

    tree: Tree
    centers: CenterPoints
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
    settled_centers, _ = settled(
        usable_points(centers), [(view.carm, view.path_mm) for view in views]
    )
    if should_stop is not None:
        # Whoever cancelled raises here; a deadline is heeded by the first step.
        should_stop()
    tree = joined_in_pictures(build_tree(settled_centers, len(views)), views)
    fit = TubeFit(
        tree=tree,
        centers=settled_centers,
        contrast=(1.0,) * len(views),
        progress=progress,
    )
    if not tree.branches:
        return fit
    return _fitted(fit, views, Run(options, progress, should_stop, evidence))


def _fitted(start: TubeFit, views: Sequence[VesselImage], run: Run) -> TubeFit:
    options, progress = run.options, run.progress
    targets: list[Target] = []
    start_radius = start.tree.radii()
    now = State(start.tree, *started_at(start.tree, options), [])
    for number, (level, steps) in enumerate(zip(options.levels_mm, options.steps, strict=True)):
        if number and (progress.stopped or progress.failed):
            break
        targets = _contrasts(make_targets(views, level, options), targets)
        prior = now.prior.at_pixel(coarsest_pixel_mm(targets), options)
        tubes, prints = fit_level(
            now.tubes, targets, prior, options, steps, progress, run.should_stop
        )
        now = State(tree_of(tubes, now.tree), tubes, prior, prints)
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
        now = settled_topology(now, views, targets, run)
        needed = needed_tree(now.tree, [target.carm for target in targets])
        if needed is not now.tree:
            now = run.fit(needed, targets, options.steps[-1])
        # Fitted ends point better than the points' did.
        whole = joined_in_pictures(now.tree, views, fitted=True)
        if whole is not now.tree:
            now = run.fit(whole, targets, options.steps[-1])
        now = _with_refitted_radii(now, targets, options)
    targets = rescaled(targets, now.prints)
    own = all(t.path_mm.shape == v.path_mm.shape for t, v in zip(targets, views, strict=True))
    return dataclasses.replace(
        start,
        tree=with_sigma(now, targets, options, run.should_stop),
        contrast=tuple(target.contrast for target in targets),
        model_mm=tuple(
            seen.image(target.path_mm.shape)
            for target, seen in zip(targets, now.prints, strict=True)
        )
        if own and not options.levels_mm[-1]
        else (),
    )


def _with_refitted_radii(now: State, targets: list[Target], options: TubeOptions) -> State:
    """Refit the radii where the pixels are fine enough to show a narrow core."""
    if coarsest_pixel_mm(targets) >= TAPER_PIXEL_MM:
        return now
    tubes, prints = refit_radii(now.tubes, targets, now.prints, options)
    return State(tree_of(tubes, now.tree), tubes, now.prior, prints)


def _contrasts(targets: list[Target], before: list[Target]) -> list[Target]:
    if not before:
        return targets
    return [
        dataclasses.replace(new, contrast=old.contrast)
        for new, old in zip(targets, before, strict=True)
    ]


def _chosen(
    now: State, start_radius: Scalars, targets: list[Target], run: Run
) -> tuple[State, tuple[CloseCall, ...]]:
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


def _supported(now: State, targets: list[Target]) -> Tree:
    """Cut what the pictures do not show, then grow along what the tree does not explain."""
    targets = rescaled(targets, now.prints)
    share = seen_share(now.tubes, targets, now.prints)
    tree = supported_tree(now.tree, now.tubes, share)
    if not tree.branches:
        return tree
    left = unexplained(targets, footprints(tubes_of(tree), targets))
    return grown_tree(tree, targets, left)


def with_sigma(
    now: State, targets: list[Target], options: TubeOptions,
    should_stop: Callable[[], bool] | None = None,
) -> Tree:  # fmt: skip
    """Return the tree with covariance and sigma per point."""
    tree, tubes = now.tree, now.tubes
    views = [
        seen_by(tubes, target, seen, options)
        for target, seen in zip(targets, now.prints, strict=True)
    ]
    tangents = np.concatenate([branch.tangents for branch in tree.branches])
    parts = spread(tubes, tangents, views, now.prior, should_stop)
    covariance = np.stack([parts.fit, parts.geometry], axis=1)
    sigma = worst_sigma(parts.fit + parts.geometry)
    branches = []
    for k, branch in enumerate(tree.branches):
        own = tubes.point_branch == k
        branches.append(
            dataclasses.replace(branch, sigma_mm=sigma[own], covariance_mm2=covariance[own])
        )
    return dataclasses.replace(tree, branches=tuple(branches))
