"""Visual hull: a voxel is vessel if every view sees vessel at its centre's pixel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.types import Image, Volume

#: a pixel is vessel from this path length on, mm.
PATH_THRESHOLD_MM = 0.5


def visual_hull(
    path_mm: Sequence[Image],
    carms: Sequence[CArm],
    grid: Grid,
    least_path_mm: float = PATH_THRESHOLD_MM,
) -> Volume:
    """Carve the grid by the silhouettes of all views.

    Parameters
    ----------
    path_mm : pictures (rows, columns), mm of vessel along each pixel's ray
    carms : their views
    grid : voxels wanted
    least_path_mm : a pixel is vessel from this path length on

    Returns
    -------
    (nx, ny, nz) float32, 0 or 1
    """
    index = np.indices(grid.shape).reshape(3, -1).T
    for picture, carm in zip(path_mm, carms, strict=True):
        pixels, depth = carm.project(grid.index2world(index))
        column, row = np.rint(pixels).astype(int).T
        seen = (depth > 0) & (row >= 0) & (row < carm.rows) & (column >= 0)
        seen &= column < carm.columns
        seen[seen] = picture[row[seen], column[seen]] >= least_path_mm
        index = index[seen]
    out = np.zeros(grid.shape, np.float32)
    out[tuple(index.T)] = 1
    return out
