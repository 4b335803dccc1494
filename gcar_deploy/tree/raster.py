"""A local raster of vessel cells: deposit, smooth, threshold, distances, neighbours.

Vessels fill some percent of the raster or less, so work is done where there is something, and what
is never written costs no memory.
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from gcar_deploy.types import Array, Scalars

#: distances to the nearest empty cell are looked up so far, in order, and searched for beyond.
NEAR_CELLS = np.array(list(np.ndindex(5, 5, 5)), np.int64) - 2
#: steps to a cell's 26 neighbours, itself in the middle
STEPS = np.array(list(np.ndindex(3, 3, 3)), np.int64) - 1


def splat(at: Array, weight: Scalars, shape: Array) -> Array:
    """Trilinear deposit of (n,) weights at (n, 3) cell coordinates."""
    at = np.where(np.abs(at - np.rint(at)) < 1e-6, np.rint(at), at)
    base = np.floor(at).astype(np.int64)
    # Of either neighbour along each axis: its share.
    sides = [(1 - s, s) for s in np.ascontiguousarray((at - base).T)]
    first, strides = np.ravel_multi_index(tuple(base.T), tuple(shape)), _strides(shape)
    flat, part = [], []
    for x, y, z in np.ndindex(2, 2, 2):
        w = weight * (sides[0][x] * sides[1][y] * sides[2][z])
        some = np.flatnonzero(w > 0)
        flat.append(first[some] + np.array([x, y, z]) @ strides)
        part.append(w[some])
    out = np.bincount(np.concatenate(flat), np.concatenate(part), minlength=int(shape.prod()))
    return out.reshape(shape)


def blurred(volume: Array, sigma: float, truncate: float) -> Array:
    """Gaussian smoothing, float32; beyond the raster there is nothing."""
    reach = int(truncate * sigma + 0.5)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel = (kernel / kernel.sum()).astype(np.float32)
    out = volume
    for count, stride in zip(volume.shape, _strides(volume.shape), strict=True):
        flat = np.flatnonzero(out != 0)
        values = out.reshape(-1)[flat].astype(np.float32)
        place = flat // stride % count
        out = np.zeros(volume.shape, np.float32)
        cells = out.reshape(-1)
        for step, share in zip(range(-reach, reach + 1), kernel, strict=True):
            inside = (place >= -step) & (place < count - step)
            cells[flat[inside] + step * stride] += share * values[inside]
    return out


def peaks(volume: Array, cells: Array) -> Array:
    """(n,) highest value within two cells along every axis of (n, 3) cells."""
    near = [
        [np.clip(at + step, 0, count - 1) * stride for step in range(-2, 3)]
        for at, count, stride in zip(cells.T, volume.shape, _strides(volume.shape), strict=True)
    ]
    values = volume.reshape(-1)
    out: Array = values[near[0][2] + near[1][2] + near[2][2]]
    for x, y, z in itertools.product(*near):
        np.maximum(out, values[x + y + z], out=out)
    return out


def _strides(shape: tuple[int, ...] | Array) -> Array:
    """(3,) by how much the flat index grows along each axis."""
    return np.array([shape[1] * shape[2], shape[2], 1], np.int64)


def hysteresis(value: Array, low: float, high: float) -> Array:
    """Cells from ``low`` on that are connected (26) to one from ``high`` on; none on the border."""
    some = np.flatnonzero(value >= low)
    pairs, _ = touching(np.stack(np.unravel_index(some, value.shape), axis=1), value.shape)
    links = sparse.csr_matrix((np.ones(len(pairs)), pairs.T), shape=(len(some), len(some)))
    count, part = csgraph.connected_components(links, directed=False)
    strong = np.zeros(count, bool)
    strong[part[value.reshape(-1)[some] >= high]] = True
    out = np.zeros(value.shape, bool)
    out.reshape(-1)[some[strong[part]]] = True
    return out


def depth_of(cells: Array, mask: Array) -> Scalars:
    """(n,) distance from each cell to the nearest one outside ``mask``, cells."""
    flat = np.ravel_multi_index(tuple(cells.T), mask.shape)
    stride = _strides(mask.shape)
    inside = mask.reshape(-1)
    length = np.sqrt(np.einsum("ij,ij->i", NEAR_CELLS, NEAR_CELLS).astype(np.float64))
    out = np.full(len(cells), np.inf)
    left = np.arange(len(cells))
    # Beyond two cells along an axis there may be nearer ones than those looked at.
    for k in np.argsort(length, kind="stable"):
        if length[k] > 2 or not len(left):
            break
        out_here = ~inside[flat[left] + NEAR_CELLS[k] @ stride]
        out[left[out_here]] = length[k]
        left = left[~out_here]
    if len(left):
        around = np.flatnonzero(_grown(cells, mask.shape))
        outside = np.unravel_index(around[~inside[around]], mask.shape)
        out[left] = cKDTree(np.stack(outside, axis=1)).query(cells[left])[0]
    return out


def _grown(cells: Array, shape: tuple[int, ...]) -> Array:
    """Flat mask of cells and their 26 neighbours; no cell lies on the border of ``shape``."""
    out = np.zeros(int(np.prod(shape)), bool)
    flat = np.ravel_multi_index(tuple(cells.T), shape)
    for offset in STEPS @ _strides(shape):
        out[flat + offset] = True
    return out


def touching(cells: Array, shape: tuple[int, ...]) -> tuple[Array, Scalars]:
    """(p, 2) pairs among the 26 neighbours, and (p,) their distance, cells."""
    flat = np.ravel_multi_index(tuple(cells.T), shape)
    # From 1 on: nothing is written where there is no cell.
    number = np.zeros(int(np.prod(shape)), np.int32)
    number[flat] = np.arange(1, len(cells) + 1)
    pairs, length = [], []
    strides = _strides(shape)
    # Of each two neighbours one is ahead.
    for step in STEPS[14:]:
        other = number[flat + step @ strides]
        here = np.flatnonzero(other)
        pairs.append(np.stack([here, other[here] - 1], axis=1))
        length.append(np.full(len(here), np.sqrt(float(step @ step))))
    return np.concatenate(pairs), np.concatenate(length)
