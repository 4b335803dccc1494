"""The one way into refinement: from starting points and pictures to Gaussians and tree."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.config import REFINERS, RefineOptions
from gcar_deploy.config.ranges import check_choice
from gcar_deploy.errors import NumericalError, UsageError
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.gaussians.gaussians import Gaussians
from gcar_deploy.gaussians.voxelize import points_of, voxelize
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.stopwatch import Budget
from gcar_deploy.tree.centerline import build_tree
from gcar_deploy.tree.edit import without_branch_at
from gcar_deploy.tree.occupancy import tree_occupancy
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.choice import CloseCall
from gcar_deploy.tubes.fit import fit_tubes
from gcar_deploy.tubes.gauss_newton import Ending
from gcar_deploy.tubes.gaussians import gaussians_on_tree
from gcar_deploy.tubes.volume import tube_volume
from gcar_deploy.types import Array, Volume

#: what a fit at its cap leaves to move counts from this share of the mean sigma on
MOST_LEFT = 0.5

OnProgress = Callable[[float], None]
#: a place on a branch that is to go may be so far off its centreline, mm
DELETED_WITHIN_MM = 2.0
#: trees of centres that stand on no lattice are made on one no coarser than this, mm
LARGEST_CELL_MM = 1.5
_FINDINGS = {
    "late": "the deadline left no time to refine",
    "stopped": "the deadline ended the refinement early",
}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Refined:
    """Outcome of a refinement.

    Attributes
    ----------
    refiner : str
    gaussians : Gaussians, possibly none
    tree : Tree
        Where the refiner has none of its own (``paper``), made of ``centers`` as they are, or, of
        centres of single views, which are no vessels yet, of the fitted Gaussians.
    losses : (k,) objective where each fit starts and after each accepted step; of ``paper`` the
        loss before each step
    steps, rejected_steps : int
    status : str
        ``ok``; ``stopped`` (deadline or cancel: the best so far); ``late`` (no time to begin);
        ``failed`` (not finite); ``empty`` (nothing to refine).
    contrast : (views,) factor of each picture's path on the model's, 1 where calibrated
    centers : CenterPoints the refinement started from
    model_mm : per view (rows, cols) what the picture tells of the fitted tubes, mm; empty where
        not at hand
    ending : how the fit ended, None where no tubes were fitted
    close_calls : pieces of vessel that were kept or dropped by a hair
    """

    refiner: str
    gaussians: Gaussians
    tree: Tree
    losses: tuple[float, ...]
    steps: int
    rejected_steps: int
    status: str
    contrast: tuple[float, ...]
    centers: CenterPoints
    model_mm: tuple[Array, ...] = ()
    ending: Ending | None = None
    close_calls: tuple[CloseCall, ...] = ()

    @property
    def findings(self) -> tuple[str, ...]:
        """Reasons for ``degraded``."""
        if self.status in _FINDINGS:
            return (_FINDINGS[self.status],)
        ending = self.ending
        if ending is None or ending.converged or not self.tree.branches:
            return ()
        sigma = np.concatenate([branch.sigma_mm for branch in self.tree.branches])
        if ending.left_mm <= MOST_LEFT * float(np.mean(sigma)):
            return ()
        return (
            f"the fit was stopped at its cap of {ending.steps} steps while the tree still moved: "
            f"some {ending.left_mm:.1f} mm are left",
        )

    def without(self, places_mm: Sequence[tuple[float, float, float]]) -> tuple[Refined, list[str]]:
        """Drop the branches that a person named by a place on each, one after the other.

        Parameters
        ----------
        places_mm : places in the tree's coordinates

        Returns
        -------
        what is left, and a sentence for each place that no branch passes (a finding)
        """
        tree, missed = self.tree, []
        for number, place in enumerate(places_mm, start=1):
            left = without_branch_at(tree, np.array(place), DELETED_WITHIN_MM)
            if left is None:
                missed.append(
                    f"deletion {number}: no branch passes within {DELETED_WITHIN_MM:g} mm of its "
                    "place"
                )
            tree = left or tree
        if tree is self.tree:
            return self, missed
        if self.refiner == "paper":
            gaussians = _nearer_to(tree, self.tree, self.gaussians)
            return dataclasses.replace(self, tree=tree, gaussians=gaussians), missed
        return self.with_tree(tree), missed

    def with_tree(self, tree: Tree) -> Refined:
        """Return the outcome with another tree, and the Gaussians on it where they go by it."""
        if tree is self.tree or self.refiner == "paper":
            return dataclasses.replace(self, tree=tree)
        return dataclasses.replace(self, tree=tree, gaussians=gaussians_on_tree(tree))

    def or_fail(self) -> Refined:
        """Return itself; raise NumericalError where the refinement failed."""
        if self.status == "failed":
            raise NumericalError("the refinement left the finite numbers")
        return self


def refine(
    centers: CenterPoints,
    views: Sequence[VesselImage],
    options: RefineOptions | None = None,
    on_progress: OnProgress | None = None,
    budget: Budget | None = None,
    evidence: CenterPoints | None = None,
) -> Refined:
    """Refine starting points so that the model's projections explain every view.

    Parameters
    ----------
    centers : CenterPoints
    views : sequence of VesselImage
    options : RefineOptions; ``refiner`` picks the method
    on_progress : called with the share done, 0 .. 1
    budget : Budget; all the time where left out
    evidence : as of ``fit_tubes``

    Raises
    ------
    UsageError
        If the refiner is unknown or there is no view.
    """
    options = options or RefineOptions()
    check_choice("refiner", options.refiner, REFINERS)
    if not views:
        raise UsageError("refinement needs at least one view")
    budget = budget or Budget()
    placed = centers
    if centers.source == "paper":
        from gcar_deploy.gaussians.paper import initial_gaussians

        # Centres of single views stand anywhere; trees are made on a lattice.
        spread = initial_gaussians(centers, options.paper)
        centers = points_of(spread, min(centers.spacing_mm, LARGEST_CELL_MM))
    if not budget.enough or options.refiner != "tube":
        start = _unrefined(centers, len(views))
        if not budget.enough:
            return dataclasses.replace(start, status="late")
        if options.refiner == "none":
            return start
        return _paper(start, placed, views, options, on_progress, budget.should_stop)
    fit = fit_tubes(centers, views, options.tube, budget.should_stop, evidence)
    if on_progress is not None:
        on_progress(1.0)
    status = "ok" if fit.tree.branches else "empty"
    status = "stopped" if fit.progress.stopped else status
    status = "failed" if fit.progress.failed else status
    return Refined(
        refiner="tube",
        gaussians=gaussians_on_tree(fit.tree),
        tree=fit.tree,
        losses=tuple(fit.progress.losses),
        steps=fit.progress.steps,
        rejected_steps=fit.progress.rejected,
        status=status,
        contrast=fit.contrast,
        centers=centers,
        model_mm=fit.model_mm,
        ending=fit.progress.ending,
        close_calls=fit.close_calls,
    )


def refined_volume(
    refined: Refined, views: Sequence[VesselImage], grid: Grid, options: RefineOptions | None = None
) -> Volume:
    """Vessel occupancy 0 .. 1 of each voxel of ``grid``, (nx, ny, nz) float32."""
    options = options or RefineOptions()
    if refined.refiner == "paper":
        return np.clip(voxelize(refined.gaussians, grid), 0.0, 1.0)
    if not options.fuse:
        return tree_occupancy(refined.tree, grid)
    if refined.refiner == "none":
        views = ()
    return tube_volume(
        refined.tree,
        grid,
        views,
        refined.contrast[: len(views)],
        refined.centers,
        options.tube.edge_blur_mm,
        refined.model_mm,
    )


def _nearer_to(left: Tree, whole: Tree, gaussians: Gaussians) -> Gaussians:
    """Gaussians that stand on the branches that are left, as near as on the whole tree."""
    if not left.branches:
        return gaussians_on_tree(left)
    kept = cKDTree(left.points()).query(gaussians.means_mm)[0]
    all_ = cKDTree(whole.points()).query(gaussians.means_mm)[0]
    return gaussians.select(kept <= all_ + 1e-9)


def _unrefined(centers: CenterPoints, views: int) -> Refined:
    """Tree and Gaussians straight from the points."""
    tree = build_tree(centers, views)
    return Refined(
        refiner="none",
        gaussians=gaussians_on_tree(tree),
        tree=tree,
        losses=(),
        steps=0,
        rejected_steps=0,
        status="ok" if tree.branches else "empty",
        contrast=(1.0,) * views,
        centers=centers,
    )


def _paper(
    start: Refined,
    centers: CenterPoints,
    views: Sequence[VesselImage],
    options: RefineOptions,
    on_progress: OnProgress | None,
    should_stop: Callable[[], bool] | None,
) -> Refined:
    from gcar_deploy.gaussians.paper import refine_paper

    out = refine_paper(
        centers, views, options.paper, on_progress=on_progress, should_stop=should_stop
    )
    tree = start.tree
    if centers.source == "paper":
        tree = build_tree(points_of(out.gaussians, start.centers.spacing_mm))
    return dataclasses.replace(
        start,
        refiner="paper",
        tree=tree,
        gaussians=out.gaussians,
        losses=tuple(out.losses),
        steps=out.steps,
        rejected_steps=out.rejected_steps,
        status=out.status,
        contrast=out.contrast,
    )
