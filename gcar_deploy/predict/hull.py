"""The visual hull on a lattice: points that every view sees as vessel.

Coarse to fine: a cell whose whole footprint is empty in any one view cannot hold vessel, so it
is dropped with all its children. Some 1 % of the cube survives; no dense volume is ever made.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.config import CandidateOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.types import Array, Image, Points

#: where a lattice stands about the origin, cells: in the middle between points, as voxels about an
#: isocentre, and a little off it, since points that project onto the very edge of a pixel would
#: be given to either side by the last digit
OFF_MIDDLE = (0.5131, 0.4913, 0.5079)
_CHILDREN = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])


@dataclasses.dataclass(frozen=True, eq=False)
class Candidates:
    """Lattice points that every view supports.

    Attributes
    ----------
    index : (n, 3) int64, position on the lattice, sorted by (x, y, z)
    points_mm : (n, 3) mm LPS
    lattice : Grid
    """

    index: Array
    points_mm: Points
    lattice: Grid

    def __len__(self) -> int:
        return len(self.index)

    @property
    def spacing_mm(self) -> float:
        """Edge of a lattice cell, mm."""
        return float(self.lattice.spacing_mm[0])


def cubic_lattice(grid: Grid, spacing_mm: float) -> Grid:
    """Cover ``grid`` with cubic cells of edge ``spacing_mm``.

    The points belong to the scene, not to the volume that is asked for: they stand at whole
    cells and ``OFF_MIDDLE`` from the origin, those inside ``grid`` (at least one along an axis).
    """
    off = np.asarray(OFF_MIDDLE) * spacing_mm
    first = np.ceil((grid.lower_mm - off) / spacing_mm - 1e-9)
    last = np.floor((grid.lower_mm + np.asarray(grid.size_mm) - off) / spacing_mm + 1e-9)
    shape = np.maximum(last - first, 0) + 1
    center = off + (first + 0.5 * (shape - 1)) * spacing_mm
    size = shape * spacing_mm
    return Grid(
        center_mm=(float(center[0]), float(center[1]), float(center[2])),
        size_mm=(float(size[0]), float(size[1]), float(size[2])),
        shape=(int(shape[0]), int(shape[1]), int(shape[2])),
        bounds=grid.bounds,
    )


def visual_hull(
    views: Sequence[tuple[CArm, Image]],
    lattice: Grid,
    options: CandidateOptions,
    among: Array | None = None,
) -> Candidates:
    """Find the lattice points whose ray holds vessel in every view.

    Parameters
    ----------
    views : sequence of (CArm, path_mm)
        (rows, columns) float32 path length in mm per view, sampled about as finely as the
        lattice; zero where there is no vessel.
    lattice : Grid with cubic cells
    options : CandidateOptions
        ``min_path_cells``: a point is kept where the path length, interpolated at its
        projection, exceeds this share of a cell's edge.
    among : (m, 3) indices of the only lattice points to ask, where they are known

    Returns
    -------
    Candidates, possibly empty
    """
    h = float(lattice.spacing_mm[0])
    if among is not None:
        points = lattice.index2world(among)
        for carm, path in views:
            keep = _supported(carm, path, points, h, True, h, options)
            among, points = among[keep], points[keep]
        return _in_order(among, points, lattice)
    shape = np.asarray(lattice.shape)
    level = int(np.floor(np.log2(max(int(shape.max()) / 12, 1))))
    blocks = -(-shape // 2**level)
    index = np.stack(np.meshgrid(*[np.arange(n) for n in blocks], indexing="ij"), -1).reshape(-1, 3)
    while True:
        size = 2**level
        # Blocks stick out of a lattice whose edge is no multiple of theirs.
        if len(index) and (index.max(axis=0) * size >= shape).any():
            index = index[(index * size < shape).all(axis=1)]
        points = lattice.index2world(index * size + (size - 1) / 2)
        for carm, path in views:
            keep = _supported(carm, path, points, size * h, level == 0, h, options)
            index, points = index[keep], points[keep]
        if level == 0:
            break
        index = (index[:, None] * 2 + _CHILDREN).reshape(-1, 3)
        level -= 1
    return _in_order(index, points, lattice)


def _in_order(index: Array, points: Points, lattice: Grid) -> Candidates:
    """Sort candidates by x, then y, then z."""
    order = np.argsort(np.ravel_multi_index(tuple(index.T), lattice.shape))
    return Candidates(index[order], points[order], lattice)


def _supported(
    carm: CArm,
    path: Image,
    points: Points,
    edge: float,
    finest: bool,
    h: float,
    options: CandidateOptions,
) -> Array:
    pixels, depth = carm.project(points)
    ahead = depth > 1.0
    least = options.min_path_cells * h
    high: Array = (path > least).astype(np.uint8)
    if finest:
        # An interpolated value is at most that of the pixels around: most points end there.
        high = cv2.dilate(high, np.ones((3, 3), np.uint8))
        keep = ahead & (_nearest(high, pixels, 1) > 0)
        keep[keep] = bilinear(path, pixels[keep]) > least
        return keep
    # The finest points of a block lie within a sphere; the pixels that one is interpolated from
    # less than a pixel from it, and the pixel of the block's middle at most half a pixel.
    nearest = max(float((depth - edge).min()), 1.0) if len(depth) else 1.0
    sphere = 0.5 * np.sqrt(3) * (edge - h) * max(carm.focal_px) / nearest
    reach = int(np.hypot(1.0, _tangent(carm)) * sphere + 1.5)
    seen = cv2.dilate(high, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    return ahead & (_nearest(seen, pixels, reach) > 0)


def _tangent(carm: CArm) -> float:
    """Tangent of the angle between the axis and the ray of the picture's farthest corner."""
    corner = np.array([[0.0, 0.0], [carm.columns, 0], [0, carm.rows], [carm.columns, carm.rows]])
    away = (corner - carm.principal_point) / carm.focal_px
    return float(np.linalg.norm(away, axis=1).max())


def _nearest(picture: Array, pixels: Array, reach: int) -> Array:
    """(n,) values at the nearest pixel; at the border up to ``reach`` outside, 0 beyond."""
    rows, cols = picture.shape
    col, row = np.rint(pixels).T
    inside = (col >= -reach) & (row >= -reach) & (col < cols + reach) & (row < rows + reach)
    out = np.zeros(len(pixels), picture.dtype)
    # What is centred outside the picture may still reach into it.
    c = np.clip(col[inside], 0, cols - 1).astype(np.int64)
    r = np.clip(row[inside], 0, rows - 1).astype(np.int64)
    out[inside] = picture[r, c]
    return out


def bilinear(image: Array, pixels: Array) -> Array:
    """(n,) values of ``image`` at (n, 2) pixels (col, row), bilinear; zero outside."""
    return bilinear_of([image], pixels)[0]


def bilinear_of(images: Sequence[Array], pixels: Array) -> Array:
    """(k, n) values of k images of one size, as ``bilinear`` gives those of one."""
    rows, cols = images[0].shape
    col, row = pixels[:, 0], pixels[:, 1]
    inside = (col > -1) & (row > -1) & (col < cols) & (row < rows)
    c, r = col[inside], row[inside]
    c0, r0 = np.floor(c).astype(np.int64), np.floor(r).astype(np.int64)
    fc, fr = c - c0, r - r0
    padded = [np.pad(image, 1).reshape(-1) for image in images]
    total = np.zeros((len(images), len(c)))
    for dr, wr in ((0, 1 - fr), (1, fr)):
        for dc, wc in ((0, 1 - fc), (1, fc)):
            weight = wr * wc
            at = (r0 + 1 + dr) * (cols + 2) + c0 + 1 + dc
            for sums, image in zip(total, padded, strict=True):
                sums += weight * image[at]
    if inside.all():
        return total
    out = np.zeros((len(images), len(pixels)))
    out[:, inside] = total
    return out
