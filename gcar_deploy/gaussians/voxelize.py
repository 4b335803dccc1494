"""From Gaussians to an occupancy volume (3DGR-CAR, eq. 2), averaged over each voxel."""

from __future__ import annotations

import numpy as np

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.gaussians.gaussians import Gaussians
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.types import Array, Volume

#: half width of a Gaussian's box in standard deviations; beyond lies 0.02 % of the mass
CUT_SIGMAS = 4.0
#: of ``points_of``: cells round the Gaussians, and the occupancy below which a cell is left out
_MARGIN_CELLS, _LEAST_SHARE = 3, 0.02
#: Gaussians whose boxes hold about as many voxels are done together
_BUCKET = 1.6


def voxelize(gaussians: Gaussians, grid: Grid) -> Volume:
    """Sum of all Gaussians, box-averaged over the voxels of ``grid``.

    The average of a Gaussian over a box is that of its convolution with the box, whose variance
    edge^2 / 12 is added to the covariance. Each Gaussian's samples are then scaled so that they
    add up to its mass, which is so kept however thin it is against the voxel.

    Returns
    -------
    (nx, ny, nz) float32; not clipped, overlapping Gaussians add up
    """
    volume = np.zeros(int(np.prod(grid.shape)))
    if len(gaussians) == 0:
        return volume.reshape(grid.shape).astype(np.float32)
    spacing = grid.spacing_mm
    covariance = gaussians.covariances() + np.diag(spacing**2 / 12.0)
    in_voxels = gaussians.masses_mm3() / np.prod(spacing)
    inverse = np.linalg.inv(covariance)
    reach = CUT_SIGMAS * np.sqrt(np.einsum("nii->ni", covariance)) / spacing
    centre = grid.world2index(gaussians.means_mm)
    low = np.ceil(centre - reach).astype(np.int64)
    count = np.floor(centre + reach).astype(np.int64) - low + 1
    side = count.max(axis=1)
    bucket = np.round(np.log(side) / np.log(_BUCKET)).astype(np.int64)
    for b in np.unique(bucket):
        chosen = np.flatnonzero(bucket == b)
        width = int(side[chosen].max())
        # Keep one block of work near 2^22 voxels, whatever the Gaussians' size.
        for part in np.array_split(chosen, max(1, len(chosen) * width**3 >> 22)):
            _add(volume, grid, low[part], width, centre[part], inverse[part], in_voxels[part])
    return volume.reshape(grid.shape).astype(np.float32)


def points_of(gaussians: Gaussians, cell_mm: float) -> CenterPoints:
    """Return the occupancy of a lattice over the Gaussians as points, empty cells left out."""
    if len(gaussians) == 0:
        nothing = np.zeros(0)
        return CenterPoints(points_mm=np.zeros((0, 3)), confidence=nothing, radius_mm=nothing,
                            spacing_mm=cell_mm, source="paper")  # fmt: skip
    # A few Gaussians that ran away must not make the lattice large.
    low, high = np.percentile(gaussians.means_mm, [0.5, 99.5], axis=0)
    count = np.ceil((high - low) / cell_mm).astype(int) + 2 * _MARGIN_CELLS
    (x, y, z), (nx, ny, nz) = (0.5 * (low + high)).tolist(), count.tolist()
    size = (nx * cell_mm, ny * cell_mm, nz * cell_mm)
    grid = Grid(center_mm=(x, y, z), size_mm=size, shape=(nx, ny, nz))
    share = np.clip(voxelize(gaussians, grid), 0.0, 1.0)
    filled = np.argwhere(share > _LEAST_SHARE)
    return CenterPoints(
        points_mm=grid.index2world(filled),
        confidence=share[tuple(filled.T)].astype(np.float64),
        radius_mm=np.full(len(filled), np.nan),
        spacing_mm=cell_mm,
        source="paper",
    )


def _add(
    volume: Array, grid: Grid, low: Array, width: int, centre: Array, inverse: Array, total: Array
) -> None:
    axis = np.arange(width)
    offset = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    index = low[:, None] + offset
    d = (index - centre[:, None]) * grid.spacing_mm
    q = np.einsum("nvi,nij,nvj->nv", d, inverse, d, optimize=True)
    value = np.where(q < CUT_SIGMAS**2, np.exp(-0.5 * q), 0.0)
    # What lies outside the grid counts towards the sum, and is then lost as it should be.
    value *= (total / np.maximum(value.sum(axis=1), 1e-300))[:, None]
    inside = ((index >= 0) & (index < grid.shape)).all(axis=2) & (value > 0)
    flat = np.ravel_multi_index(tuple(index[inside].T), grid.shape)
    # bincount adds in a fixed order: the same bytes every time.
    volume += np.bincount(flat, weights=value[inside], minlength=len(volume))
