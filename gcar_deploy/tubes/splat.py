"""Voxel projector for small sets of lattice cells: a sparse matrix per view."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy import sparse

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.resample import coarsened
from gcar_deploy.types import Array, Image, Points, Scalars


@dataclasses.dataclass(frozen=True, eq=False)
class CellView:
    """How cells project into one view.

    Attributes
    ----------
    matrix : (rays, cells) sparse, mm of path per unit of a cell's occupancy
    pixel : (rays,) flat pixel of each ray, only those that see a cell
    carm : CArm of the (possibly smaller) picture
    path_mm : (rows, cols) the picture at that size
    """

    matrix: sparse.csr_matrix
    pixel: Array
    carm: CArm
    path_mm: Image


def shrink_factor(carm: CArm, pixel_mm: float) -> int:
    """Pixels along an edge that make one of about ``pixel_mm`` at the isocentre."""
    return max(round(pixel_mm / carm.pixel_at_isocenter_mm), 1)


def shrunk(carm: CArm, picture: Image, pixel_mm: float) -> tuple[CArm, Image]:
    """Area-average a picture so that its pixel at the isocentre is about ``pixel_mm``."""
    factor = shrink_factor(carm, pixel_mm)
    if factor == 1:
        return carm, picture
    carm, (small,) = coarsened(carm, (picture,), factor)
    return carm, small


def cell_view(carm: CArm, path_mm: Image, points_mm: Points, cell_mm: float) -> CellView:
    """Bilinear footprints of cells with edge ``cell_mm`` in a picture of about that pixel size.

    The volume of a cell is kept: its footprint sums to cell volume over pixel area at its depth.
    """
    carm, path_mm = shrunk(carm, path_mm, cell_mm)
    rows, cols = path_mm.shape
    pixels, depth = carm.project(points_mm)
    pixels = np.where(depth[:, None] > 1.0, pixels, -10.0)
    base = np.floor(pixels).astype(np.int64)
    share = pixels - base
    mass = cell_mm**3 * np.prod(carm.focal_px) / np.maximum(depth, 1.0) ** 2
    index = np.arange(len(points_mm))
    parts: list[tuple[Array, Array, Scalars]] = []
    for dr in (0, 1):
        for dc in (0, 1):
            r, c = base[:, 1] + dr, base[:, 0] + dc
            w = (share[:, 0] if dc else 1 - share[:, 0]) * (share[:, 1] if dr else 1 - share[:, 1])
            ok = (r >= 0) & (c >= 0) & (r < rows) & (c < cols) & (w > 0)
            parts.append(((r * cols + c)[ok], index[ok], (w * mass)[ok]))
    flat, cell, weight = (np.concatenate(x) for x in zip(*parts, strict=True))
    pixel, row = np.unique(flat, return_inverse=True)
    matrix = sparse.csr_matrix((weight, (row, cell)), shape=(len(pixel), len(points_mm)))
    return CellView(matrix, pixel, carm, path_mm)


def cell_views(
    views: Sequence[tuple[CArm, Image]], points_mm: Points, cell_mm: float
) -> list[CellView]:
    """``cell_view`` for every (carm, path_mm)."""
    return [cell_view(carm, path, points_mm, cell_mm) for carm, path in views]
