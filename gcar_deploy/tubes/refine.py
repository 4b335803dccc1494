"""The one way into refinement: from starting points and pictures to Gaussians and tree."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from gcar_deploy.config import RefineOptions, TreeOptions
from gcar_deploy.errors import UsageError
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.gaussians.gaussians import Gaussians
from gcar_deploy.gaussians.voxelize import voxelize
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.tree.centerline import build_tree
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.fit import fit_tubes
from gcar_deploy.tubes.gaussians import strung_gaussians
from gcar_deploy.tubes.volume import tube_volume
from gcar_deploy.types import Array, Volume

REFINERS = ("tube", "paper", "none")
ShouldStop = Callable[[], bool]
OnProgress = Callable[[float], None]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Refined:
    """Outcome of a refinement.

    Attributes
    ----------
    refiner : str
    gaussians : Gaussians, possibly none
    tree : Tree or None
        None where the refiner makes no tree of its own (``paper``).
    losses : (k,) objective after each accepted step
    steps, rejected_steps : int
    status : str
        ``ok``; ``stopped`` (deadline or cancel: the best so far); ``failed`` (not finite);
        ``empty`` (nothing to refine).
    contrast : (views,) factor of each picture's path on the model's, 1 where calibrated
    centers : CenterPoints the refinement started from
    model_mm : per view (rows, cols) path of the fitted tubes, mm; empty where not at hand
    """

    refiner: str
    gaussians: Gaussians
    tree: Tree | None
    losses: tuple[float, ...]
    steps: int
    rejected_steps: int
    status: str
    contrast: tuple[float, ...]
    centers: CenterPoints
    model_mm: tuple[Array, ...] = ()


def refine(
    centers: CenterPoints,
    views: Sequence[VesselImage],
    options: RefineOptions | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
    *,
    tree_options: TreeOptions | None = None,
) -> Refined:
    """Refine starting points so that the model's projections explain every view.

    Parameters
    ----------
    centers : CenterPoints
    views : sequence of VesselImage
    options : RefineOptions; ``refiner`` picks the method
    on_progress : called with the share done, 0 .. 1
    should_stop : asked before each step; True ends with the best so far
    tree_options : TreeOptions for the refiners that build a tree

    Raises
    ------
    UsageError
        If the refiner is unknown or there is no view.
    """
    options = options or RefineOptions()
    if options.refiner not in REFINERS:
        raise UsageError(f"refiner {options.refiner!r} is none of {', '.join(REFINERS)}")
    if not views:
        raise UsageError("refinement needs at least one view")
    if options.refiner == "paper":
        return _paper(centers, views, options, on_progress, should_stop)
    if options.refiner == "none":
        return _unrefined(centers, len(views), options, tree_options)
    fit = fit_tubes(centers, views, options.tube, tree_options, should_stop)
    if on_progress is not None:
        on_progress(1.0)
    status = "ok" if fit.tree.branches else "empty"
    status = "stopped" if fit.progress.stopped else status
    status = "failed" if fit.progress.failed else status
    return Refined(
        refiner="tube",
        gaussians=strung_gaussians(fit.tree),
        tree=fit.tree,
        losses=tuple(fit.progress.losses),
        steps=fit.progress.steps,
        rejected_steps=fit.progress.rejected,
        status=status,
        contrast=fit.contrast,
        centers=centers,
        model_mm=fit.model_mm,
    )


def refined_volume(
    refined: Refined, views: Sequence[VesselImage], grid: Grid, options: RefineOptions | None = None
) -> Volume:
    """Vessel occupancy 0 .. 1 of each voxel of ``grid``, (nx, ny, nz) float32."""
    options = options or RefineOptions()
    if refined.tree is None:
        return np.clip(voxelize(refined.gaussians, grid), 0.0, 1.0)
    if refined.refiner == "none":
        views = ()
    return tube_volume(
        refined.tree,
        grid,
        views,
        refined.contrast[: len(views)],
        refined.centers,
        options.tube.edge_blur_mm,
        options.volume,
        refined.model_mm,
    )


def _unrefined(
    centers: CenterPoints, views: int, options: RefineOptions, tree_options: TreeOptions | None
) -> Refined:
    """Tree and Gaussians straight from the points."""
    tree = build_tree(centers, tree_options)
    return Refined(
        refiner="none",
        gaussians=strung_gaussians(tree),
        tree=tree,
        losses=(),
        steps=0,
        rejected_steps=0,
        status="ok" if tree.branches else "empty",
        contrast=(1.0,) * views,
        centers=centers,
    )


def _paper(
    centers: CenterPoints,
    views: Sequence[VesselImage],
    options: RefineOptions,
    on_progress: OnProgress | None,
    should_stop: ShouldStop | None,
) -> Refined:
    from gcar_deploy.gaussians.paper import refine_paper

    out = refine_paper(
        centers, views, options.paper, on_progress=on_progress, should_stop=should_stop
    )
    return Refined(
        refiner="paper",
        gaussians=out.gaussians,
        tree=None,
        losses=tuple(out.losses),
        steps=out.steps,
        rejected_steps=out.rejected_steps,
        status=out.status,
        contrast=out.contrast,
        centers=centers,
    )
