"""Voxel occupancy of a tree: area-averaged coverage of the union of its tapered capsules.

Sparse: only voxels near a capsule are ever looked at, and only those the surface passes
through are supersampled.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from gcar_deploy.geometry.grid import MOST_VOXELS, Grid
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Points, Scalars, Volume

#: samples per voxel edge where the surface passes through.
SAMPLES = 3
#: wider voxels are summed up from finer ones, if a Grid may have so many: their samples would miss
#: the vessels, mm
WIDEST_MM = 4.0
#: capsule-voxel pairs handled at once: what is made of them stays in the cache
CHUNK = 80_000


def tree_occupancy(tree: Tree, grid: Grid) -> Volume:
    """Share of each voxel that lies inside the tubes.

    Parameters
    ----------
    tree : Tree
    grid : Grid
        Voxels may be oblong.

    Returns
    -------
    (nx, ny, nz) float32, 0 .. 1
    """
    out = np.zeros(grid.shape, np.float32)
    voxels, coverage = sparse_occupancy(tree, grid)
    out.reshape(-1)[voxels] = coverage
    return out


def sparse_occupancy(tree: Tree, grid: Grid) -> tuple[Array, Array]:
    """Like ``tree_occupancy``, but only (n,) flat voxel indices and their coverage."""
    parts = np.ceil(grid.spacing_mm / WIDEST_MM).astype(np.int64)
    shape = parts * grid.shape
    if parts.max() > 1 and shape.prod() <= MOST_VOXELS:
        fine = dataclasses.replace(grid, shape=tuple(shape.tolist()))
        voxel, coverage = sparse_occupancy(tree, fine)
        at = np.stack(np.unravel_index(voxel, fine.shape)) // parts[:, None]
        whole, slot = np.unique(np.ravel_multi_index(tuple(at), grid.shape), return_inverse=True)
        share = np.bincount(slot, coverage, len(whole)) / parts.prod()
        return whole, share.astype(np.float32)
    capsules = tree.segments()
    half_diagonal = 0.5 * float(np.linalg.norm(grid.spacing_mm))
    voxel, capsule, distance = near_pairs(capsules, grid, half_diagonal)
    if not len(voxel):
        return np.zeros(0, np.int64), np.zeros(0, np.float32)
    order = np.argsort(voxel, kind="stable")
    voxel, capsule, distance = voxel[order], capsule[order], distance[order]
    first = np.flatnonzero(np.concatenate([[True], voxel[1:] != voxel[:-1]]))
    nearest = np.minimum.reduceat(distance, first)
    which = np.cumsum(np.concatenate([[0], (voxel[1:] != voxel[:-1]).astype(np.int64)]))
    coverage = np.ones(len(first), np.float32)
    # A capsule further from the middle than the nearest by a diagonal never wins a sample.
    rim = (nearest[which] > -half_diagonal) & (distance < nearest[which] + 2 * half_diagonal)
    if rim.any():
        border, slot = np.unique(which[rim], return_inverse=True)
        coverage[border] = _supersampled(
            voxel[rim], slot, len(border), capsules, capsule[rim], grid
        )
    return voxel[first], coverage


def near_pairs(
    capsules: tuple[Points, Points, Scalars, Scalars], grid: Grid, far_mm: float
) -> tuple[Array, Array, Scalars]:
    """Pair each capsule with the voxels whose middle lies less than ``far_mm`` outside it.

    Returns
    -------
    voxel : (p,) int64 flat index
    capsule : (p,) int64, rising
    distance_mm : (p,) signed distance of the voxel's middle to that capsule, negative inside; the
        radius is that at the foot of the perpendicular, which is exact for constant radius and
        right to second order in the taper
    """
    a, b, ra, rb = capsules
    reach = (np.maximum(ra, rb) + far_mm)[:, None]
    low = np.ceil(grid.world2index(np.minimum(a, b) - reach)).astype(np.int64)
    high = np.floor(grid.world2index(np.maximum(a, b) + reach)).astype(np.int64) + 1
    low = np.clip(low, 0, grid.shape)
    size = np.maximum(np.clip(high, 0, grid.shape) - low, 0)
    # Columns along z of the box round each capsule: most of the sums are the same along one.
    count = size[:, 0] * size[:, 1] * (size[:, 2] > 0)
    own = np.repeat(np.arange(len(a)), count)
    within = np.arange(len(own)) - np.repeat(np.cumsum(count) - count, count)
    x, y = low[own, 0] + within // size[own, 1], low[own, 1] + within % size[own, 1]
    height = size[own, 2]
    found = [
        _near_columns((x[part], y[part], low[own[part], 2], height[part]), capsules, own[part],
                      grid, far_mm)
        for part in _chunks(np.cumsum(height), CHUNK)
    ]  # fmt: skip
    if not found:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    voxel, capsule, distance = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return voxel, capsule, distance


def _near_columns(
    columns: tuple[Array, Array, Array, Array], capsules: tuple[Points, Points, Scalars, Scalars],
    own: Array, grid: Grid, far_mm: float,
) -> tuple[Array, Array, Scalars]:  # fmt: skip
    """``near_pairs`` of columns (x, y, first z, height) with one capsule each."""
    x, y, first, height = columns
    a, b, ra, rb = capsules
    axis = b - a
    length2 = np.maximum(np.einsum("ij,ij->i", axis, axis), 1e-18)
    lower, spacing = grid.lower_mm, grid.spacing_mm
    rx = lower[0] + (x + 0.5) * spacing[0] - a[own, 0]
    ry = lower[1] + (y + 0.5) * spacing[1] - a[own, 1]
    along = rx * axis[own, 0] + ry * axis[own, 1]
    flat = (x * grid.shape[1] + y) * grid.shape[2]
    # What is one along a column, beside its height: repeating rows is faster than looking up.
    table = [along, axis[own, 2], a[own, 2], length2[own], rx, axis[own, 0], ry, axis[own, 1],
             ra[own], (rb - ra)[own]]  # fmt: skip
    along, az, rz, square, dx, ax, dy, ay, radius, taper = np.repeat(
        np.array(table), height, axis=1
    )
    column = np.repeat(np.arange(len(x)), height)
    z = np.arange(len(column)) - np.repeat(np.cumsum(height) - height - first, height)
    rz = lower[2] + (z + 0.5) * spacing[2] - rz
    t = (along + rz * az) / square
    t = np.minimum(np.maximum(t, 0.0), 1.0)
    dx -= t * ax
    dy -= t * ay
    rz -= t * az
    distance = np.sqrt(dx * dx + dy * dy + rz * rz) - (radius + t * taper)
    near = np.flatnonzero(distance < far_mm)
    column = column[near]
    return flat[column] + z[near], own[column], distance[near]


def _supersampled(
    voxel: Array, slot: Array, count: int, capsules: tuple, capsule: Array, grid: Grid
) -> Array:
    """Coverage of ``count`` border voxels; pairs (voxel, capsule) sorted by ``slot``.

    Each of SAMPLES^3 sub-cells counts by how far its middle lies inside, as if the surface
    were flat across it: much less noisy than counting middles.
    """
    center = grid.index2world(np.stack(np.unravel_index(voxel, grid.shape), axis=1))
    first = np.flatnonzero(np.concatenate([[True], slot[1:] != slot[:-1]]))
    step = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    offsets = np.stack(np.meshgrid(step, step, step, indexing="ij"), -1).reshape(-1, 3)
    width = float(grid.spacing_mm.mean()) / SAMPLES
    # A soft rim of that width adds width^2 / 12 to r^2 in the area of a round section.
    starts, ends, *radii = capsules
    thin = [np.sqrt(np.maximum(r * r - width * width / 12, 0.01 * width * width)) for r in radii]
    capsules = (starts, ends, thin[0], thin[1])
    a, b, ra, rb = (np.ascontiguousarray(x[capsule]) for x in capsules)
    axis, rel = b - a, center - a
    length2 = np.maximum(np.einsum("ij,ij->i", axis, axis), 1e-18)
    inverse, taper = 1.0 / length2, rb - ra
    # With x = rel + offset: |x - t axis|^2 = |x|^2 - t (2 x.axis - t |axis|^2).
    along0 = np.einsum("ij,ij->i", rel, axis)
    square0 = np.einsum("ij,ij->i", rel, rel)
    total = np.zeros(count)
    for offset in offsets * grid.spacing_mm:
        along = along0 + axis @ offset
        square = square0 + (2 * rel) @ offset + offset @ offset
        t = np.clip(along * inverse, 0.0, 1.0)
        square -= t * (2 * along - t * length2)
        distance = np.sqrt(np.maximum(square, 0.0)) - (ra + t * taper)
        inside = np.minimum.reduceat(distance, first)
        total += np.clip(0.5 - inside / width, 0.0, 1.0)
    return (total / len(offsets)).astype(np.float32)


def _chunks(total: Array, size: int) -> list[slice]:
    """Slices of columns that hold some ``size`` voxels each; ``total`` is their running sum."""
    if not len(total):
        return []
    cuts = np.searchsorted(total, np.arange(size, int(total[-1]), size), side="left") + 1
    cuts = np.unique(np.concatenate([[0], cuts, [len(total)]])).tolist()
    return [slice(start, stop) for start, stop in itertools.pairwise(cuts)]
