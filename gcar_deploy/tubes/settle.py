"""Settle scattered points where vessel would have to be for points and pictures to agree.

Points whose positions are uncertain by sigma are a blurred sample of the vessel. On the cells
that every view sees as vessel, occupancy and sigma are estimated together by expectation
maximisation (each point belongs to the cells round it in proportion to occupancy times
Gaussian), interleaved with multiplicative updates (MLEM) by the pictures. Points that lie on a
lattice have no scatter and are left as they are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.tubes.splat import CellView, cell_views
from gcar_deploy.types import Array, Image, Points, Scalars

#: first guess of the scatter and how far cells may be from a point, lattice cells.
FIRST_SIGMA = 1.0
REACH = 4.5
#: cells are taken so many along each axis from a point: the corners of that box are ``REACH``
#: away (that over the root of 3, rounded up)
CELLS_ABOUT = 3
#: a cell is left out where a view shows less path on it on average, mm: the thinnest tube of the
#: fit is 0.4 mm wide
LEAST_PATH_MM = 0.35
#: occupancy below which a settled cell is dropped.
DROP_BELOW = 0.02
ITERATIONS = 12


def scatter_is_none(centers: CenterPoints) -> bool:
    """Whether all points lie on one lattice of their own spacing."""
    if len(centers) < 2:
        return True
    at = (centers.points_mm - centers.points_mm[0]) / centers.spacing_mm
    return bool(np.abs(at - np.rint(at)).max() < 0.02)


def settled(
    centers: CenterPoints, views: Sequence[tuple[CArm, Image]]
) -> tuple[CenterPoints, float]:
    """Move the points' confidence onto lattice cells that points and pictures agree on.

    Parameters
    ----------
    centers : CenterPoints
    views : sequence of (CArm, path_mm)

    Returns
    -------
    centers : CenterPoints on a lattice (unchanged if they already were, or if nothing is left)
    sigma_mm : float, estimated scatter of the positions, 0 on a lattice
    """
    if scatter_is_none(centers) or not len(views):
        return centers, 0.0
    h = centers.spacing_mm
    cells = _cells_near(centers, h)
    seen = cell_views(views, cells, h)
    for _ in range(2):
        keep = _seen_by_all(seen, len(cells))
        if keep.all():
            break
        cells = cells[keep]
        seen = cell_views(views, cells, h)
    if not len(cells):
        return centers, 0.0
    occupancy, sigma = _estimate(centers, cells, seen, h)
    keep = occupancy > DROP_BELOW
    out = CenterPoints(
        points_mm=cells[keep],
        confidence=np.minimum(occupancy[keep], 1.0),
        radius_mm=np.full(int(keep.sum()), np.nan),
        spacing_mm=h,
        source=centers.source,
    )
    return out, sigma


def _cells_near(centers: CenterPoints, h: float) -> Points:
    """Lattice cells up to ``CELLS_ABOUT`` along each axis from any point."""
    index = np.unique(np.rint(centers.points_mm / h).astype(np.int64), axis=0)
    low = index.min(axis=0) - CELLS_ABOUT
    shape = index.max(axis=0) + CELLS_ABOUT + 1 - low
    mask = np.zeros(shape, bool)
    mask[tuple((index - low).T)] = True
    mask = ndimage.binary_dilation(mask, np.ones((3, 3, 3)), iterations=CELLS_ABOUT)
    return (np.argwhere(mask) + low) * h


def _seen_by_all(seen: list[CellView], count: int) -> Array:
    keep = np.ones(count, bool)
    for view in seen:
        path = view.path_mm.reshape(-1)[view.pixel]
        norm = np.asarray(view.matrix.sum(axis=0)).ravel()
        mean = (view.matrix.T @ path) / np.maximum(norm, 1e-9)
        keep &= mean > LEAST_PATH_MM
    return keep


def _estimate(
    centers: CenterPoints, cells: Points, seen: list[CellView], h: float
) -> tuple[Scalars, float]:
    near = cKDTree(centers.points_mm).sparse_distance_matrix(
        cKDTree(cells), REACH * h, output_type="coo_matrix"
    )
    point, cell, d2 = near.row, near.col, near.data**2
    weight = centers.confidence
    occupancy = np.full(len(cells), 0.3)
    paths = [view.path_mm.reshape(-1)[view.pixel].astype(np.float64) for view in seen]
    norms = [np.asarray(view.matrix.sum(axis=0)).ravel() for view in seen]
    for view, path, norm in zip(seen, paths, norms, strict=True):
        occupancy *= _ratio(view, path, norm, occupancy)
    sigma2 = (FIRST_SIGMA * h) ** 2
    for _ in range(ITERATIONS):
        share = occupancy[cell] * np.exp(-0.5 * d2 / sigma2)
        total = np.bincount(point, share, minlength=len(weight))
        share *= (weight / np.maximum(total, 1e-12))[point]
        spread = float((share * d2).sum() / max(share.sum(), 1e-12)) / 3
        # A cell is a box, not a point: h^2/12 of the spread is its own.
        sigma2 = float(np.clip(spread - h * h / 12, (0.15 * h) ** 2, (2.5 * h) ** 2))
        occupancy = np.bincount(cell, share, minlength=len(cells)).astype(np.float64) + 1e-4
        for view, path, norm in zip(seen, paths, norms, strict=True):
            occupancy *= _ratio(view, path, norm, occupancy)
        occupancy = np.minimum(occupancy, 1.2)
    return occupancy, float(np.sqrt(sigma2))


def _ratio(view: CellView, path: Scalars, norm: Scalars, occupancy: Scalars) -> Scalars:
    model = view.matrix @ occupancy
    ratio = (path + 1e-3) / (model + 0.05 * path + 1e-3)
    out: Scalars = np.clip((view.matrix.T @ ratio) / np.maximum(norm, 1e-9), 0.2, 3.0)
    return out
