"""Gaussian centres from filtered backprojection, as in "3DGR-FBP" (Li et al. 2023)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.types import Image, Volume


def fbp_centers(
    volume: Volume, grid: Grid, path_mm: Sequence[Image], carms: Sequence[CArm], count: int
) -> CenterPoints:
    """Take the ``count`` voxels with the highest values.

    Their values become confidences, scaled by one factor so that the points together hold
    the vessel volume that the pictures show: backprojection spreads it over whole rays.

    Parameters
    ----------
    volume : (nx, ny, nz) backprojection, 0 .. 1
    grid : its voxels
    path_mm : pictures (rows, columns), mm of vessel along each pixel's ray
    carms : their views
    count : most points
    """
    flat = volume.ravel()
    chosen = np.argsort(-flat, kind="stable")[:count]
    chosen = np.sort(chosen[flat[chosen] > 0])
    cell = float(np.prod(grid.spacing_mm))
    areas = [carm.pixel_at_isocenter_mm**2 for carm in carms]
    shown = [float(p.sum()) * area for p, area in zip(path_mm, areas, strict=True)]
    value = flat[chosen].astype(np.float64)
    factor = float(np.mean(shown)) / max(float(value.sum()) * cell, 1e-12)
    return CenterPoints(
        points_mm=grid.index2world(np.column_stack(np.unravel_index(chosen, grid.shape))),
        confidence=np.clip(value * factor, 0.0, 1.0),
        radius_mm=np.full(len(chosen), np.nan),
        spacing_mm=cell ** (1 / 3),
        source="hull",
    )
