"""A local raster of vessel cells: deposit, smooth, threshold, distances, neighbours.

Vessels fill some percent of the raster, and only the filters run over all of it.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from gcar_deploy.types import Array, Scalars

#: distances to the nearest empty cell are looked up so far, in order, and searched for beyond.
NEAR_CELLS = np.array(list(np.ndindex(5, 5, 5)), np.int64) - 2


def splat(at: Array, weight: Scalars, shape: Array) -> Array:
    """Trilinear deposit of (n,) weights at (n, 3) cell coordinates."""
    at = np.where(np.abs(at - np.rint(at)) < 1e-6, np.rint(at), at)
    base = np.floor(at).astype(np.int64)
    # Of either neighbour along each axis: its share.
    sides = [(1 - s, s) for s in np.ascontiguousarray((at - base).T)]
    first = np.ravel_multi_index(tuple(base.T), tuple(shape))
    flat, part = [], []
    for x, y, z in np.ndindex(2, 2, 2):
        w = weight * (sides[0][x] * sides[1][y] * sides[2][z])
        some = np.flatnonzero(w > 0)
        flat.append(first[some] + (x * shape[1] + y) * shape[2] + z)
        part.append(w[some])
    out = np.bincount(np.concatenate(flat), np.concatenate(part), minlength=int(shape.prod()))
    return out.reshape(shape)


def blurred(volume: Array, sigma: float, truncate: float) -> Array:
    """Gaussian smoothing, float32; beyond the raster there is nothing."""
    reach = int(truncate * sigma + 0.5)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel = (kernel / kernel.sum()).astype(np.float32)
    one = np.ones(1, np.float32)

    def smooth(image: Array, down: bool) -> Array:
        along, across = (one, kernel) if down else (kernel, one)
        out: Array = cv2.sepFilter2D(
            image, cv2.CV_32F, along, across, borderType=cv2.BORDER_CONSTANT
        )
        return out

    return _by_axis(volume, smooth)


def _by_axis(volume: Array, filtered: Callable[[Array, bool], Array]) -> Array:
    """Filter (rows, cols) float32 pictures made of a volume along each of its axes in turn.

    ``filtered`` takes a picture and whether to filter down its columns, else along its rows.
    """
    shape = volume.shape
    image: Array = np.ascontiguousarray(volume, dtype=np.float32).reshape(shape[0], -1)
    image = filtered(image, True).reshape(-1, shape[2])
    image = filtered(image, False).reshape(shape)
    return np.stack([filtered(slab, True) for slab in image])


def peaks(volume: Array) -> Array:
    """Highest value within two cells along every axis, float32."""
    five = np.ones(5, np.uint8)

    def highest(image: Array, down: bool) -> Array:
        return cv2.dilate(image, five[:, None] if down else five[None])

    return _by_axis(volume, highest)


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
    stride = np.array([mask.shape[1] * mask.shape[2], mask.shape[2], 1])
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
        outside = np.argwhere(_grown(cells, mask.shape) & ~mask)
        out[left] = cKDTree(outside).query(cells[left])[0]
    return out


def _grown(cells: Array, shape: tuple[int, ...]) -> Array:
    """Mask of the cells and their 26 neighbours; no cell lies on the border of ``shape``."""
    out = np.zeros(int(np.prod(shape)), bool)
    flat = np.ravel_multi_index(tuple(cells.T), shape)
    for dx, dy, dz in np.ndindex(3, 3, 3):
        out[flat + ((dx - 1) * shape[1] + dy - 1) * shape[2] + dz - 1] = True
    return out.reshape(shape)


def touching(cells: Array, shape: tuple[int, ...]) -> tuple[Array, Scalars]:
    """(p, 2) pairs among the 26 neighbours, and (p,) their distance, cells."""
    flat = np.ravel_multi_index(tuple(cells.T), shape)
    number = np.full(int(np.prod(shape)), -1, np.int32)
    number[flat] = np.arange(len(cells))
    pairs, length = [], []
    for offset in list(np.ndindex(3, 3, 3))[14:]:
        step = np.array(offset) - 1
        other = number[flat + (step[0] * shape[1] + step[1]) * shape[2] + step[2]]
        here = np.flatnonzero(other >= 0)
        pairs.append(np.stack([here, other[here]], axis=1))
        length.append(np.full(len(here), np.sqrt(float(step @ step))))
    return np.concatenate(pairs), np.concatenate(length)
