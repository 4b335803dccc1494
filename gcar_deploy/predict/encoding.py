"""What the sparse predictor sees: features, neighbours, coarse cells and rays as plain arrays.

Training and deployment share this file, so they cannot drift apart. Every array is an input
of the ONNX graph, which itself holds only gathers, matrix products and scatters.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.beside import side_by_side, started
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.predict.hull import OFF_MIDDLE, Candidates, bilinear_of
from gcar_deploy.types import Array, Image

#: number of per-view features that ``encode`` makes; part of the model's spec
VIEW_FEATURES = 12
#: coarser levels above the lattice itself
LEVELS = 3
#: neighbours are looked up in a table of the whole lattice up to so many cells, else searched for
MAX_TABLE = 20_000_000
_OFFSETS = np.array(
    [[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], dtype=np.int64
)


@dataclasses.dataclass(frozen=True, eq=False)
class Encoded:
    """Inputs of the sparse predictor for one scene of n points and V views.

    Attributes
    ----------
    features : (V, n, VIEW_FEATURES) float32
    ray : (V, n) int64, id of the pixel's ray within the view, dense from 0
    ray_path : (V, r) float32, path length of each ray in lattice cells (padded with zeros)
    weight : (V, n) float32, share of the ray's chord that one full cell accounts for, cells
    neighbours : per level (n_l, 27) int64, index into the level, n_l where there is none
    parent : per level but the last (n_l,) int64, index into the next level
    members : (V, r, K) int64, the points behind each ray, padded with n
    children : per level but the first (n_l, 8) int64, the cells inside, padded with n_(l-1)

    ``members`` and ``children`` say what ``ray`` and ``parent`` say, the other way round: sums
    over them are gathers with a fixed order, where scatters with repeated indices race.
    """

    features: Array
    ray: Array
    ray_path: Array
    weight: Array
    neighbours: tuple[Array, ...]
    parent: tuple[Array, ...]
    members: Array
    children: tuple[Array, ...]


def encode(candidates: Candidates, views: Sequence[tuple[CArm, Image, bool]]) -> Encoded:
    """Describe candidates by what each view shows at and around their projections.

    Parameters
    ----------
    candidates : Candidates
    views : sequence of (CArm, path_mm, calibrated)
        As given to ``visual_hull``; ``calibrated`` says whether path lengths are true mm.
    """
    h = candidates.spacing_mm
    levels = started(functools.partial(_levels, _index_in_scene(candidates)))
    per_view = side_by_side(
        [functools.partial(_view_inputs, candidates, *view, h) for view in views]
    )
    longest = max((len(p[2]) for p in per_view), default=1)
    ray_path = np.zeros((len(per_view), max(longest, 1)), np.float32)
    for k, p in enumerate(per_view):
        ray_path[k, : len(p[2])] = p[2]
    neighbours, parent = levels()
    ray = np.stack([p[1] for p in per_view])
    widest = max((int(np.bincount(r).max(initial=1)) for r in ray), default=1)
    rays = ray_path.shape[1]
    return Encoded(
        features=np.stack([p[0] for p in per_view]),
        ray=ray,
        ray_path=ray_path,
        weight=np.stack([p[3] for p in per_view]),
        neighbours=neighbours,
        parent=parent,
        members=np.stack([_inverted(r, rays, widest) for r in ray]),
        children=tuple(
            _inverted(p, len(n), 8) for p, n in zip(parent, neighbours[1:], strict=True)
        ),
    )


def _inverted(owner: Array, owners: int, width: int) -> Array:
    """(owners, width) rows of what each owner owns, in order, padded with len(owner)."""
    order = np.argsort(owner, kind="stable")
    count = np.bincount(owner, minlength=owners)
    first = np.cumsum(count) - count
    out = np.full((owners, width), len(owner), np.int64)
    out[owner[order], np.arange(len(owner)) - np.repeat(first, count)] = order
    return out


def _view_inputs(
    candidates: Candidates, carm: CArm, path_mm: Image, calibrated: bool, h: float
) -> tuple[Array, Array, Array, Array]:
    pixels, depth = carm.project(candidates.points_mm)
    path = (path_mm / h).astype(np.float32)
    rows, cols = path.shape
    col = np.clip(np.rint(pixels[:, 0]), 0, cols - 1).astype(np.int64)
    row = np.clip(np.rint(pixels[:, 1]), 0, rows - 1).astype(np.int64)
    flat, ray, count = np.unique(row * cols + col, return_inverse=True, return_counts=True)
    # One full cell on its own covers h^3 / (pixel area at its depth) of path on the pixel.
    f_col, f_row = carm.focal_px
    weight = (h * f_col / depth) * (h * f_row / depth)
    maps = [
        path,
        cv2.blur(path, (3, 3), borderType=cv2.BORDER_CONSTANT),
        cv2.blur(path, (5, 5), borderType=cv2.BORDER_CONSTANT),
        cv2.blur(path, (9, 9), borderType=cv2.BORDER_CONSTANT),
        cv2.dilate(path, np.ones((3, 3), np.uint8)),
        cv2.erode(path, np.ones((3, 3), np.uint8)),
        _depth_in_vessel(path),
    ]
    sampled = bilinear_of(maps, pixels)
    n_ray = count[ray]
    features = np.stack(
        [
            np.minimum(sampled[0], 8) / 2,
            np.minimum(sampled[1], 8) / 2,
            np.minimum(sampled[2], 8),
            np.minimum(sampled[3], 8) * 2,
            np.minimum(sampled[4], 8) / 2,
            np.minimum(sampled[5], 8) / 2,
            np.minimum(path[row, col], 8) / 2,
            np.log(n_ray) / 2,
            2 * np.minimum(path[row, col] / n_ray, 1.5),
            np.minimum(sampled[6], 6) / 2,
            np.full(len(depth), float(calibrated)),
            weight / 2,
        ],
        axis=1,
    ).astype(np.float32)
    ray_path = path.ravel()[flat]
    return features, ray.reshape(-1).astype(np.int64), ray_path, weight.astype(np.float32)


def _depth_in_vessel(path: Image) -> Image:
    """Count steps of 0.955, and diagonal ones of 1.3693, to the nearest pixel that is not vessel.

    OpenCV's own sum of them differs in its last digit with the size of the picture.
    """
    steps = cv2.distanceTransform((path > 0).astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(np.round(steps, 4))


def _index_in_scene(candidates: Candidates) -> Array:
    """(n, 3) index of which coarser cells are made, the same whatever border a picture has.

    Where nobody asked for a volume, the corner that indices are counted from follows the size of
    the pictures: it counts in whole cells of the coarsest level.
    """
    lattice, h = candidates.lattice, candidates.spacing_mm
    if lattice.bounds:
        return candidates.index
    # A lattice that is shifted by less than a cell has the corner of the one it was made of.
    corner = np.floor((lattice.lower_mm + 0.5 * h) / h - OFF_MIDDLE + 1e-3).astype(np.int64)
    return candidates.index + corner % 2**LEVELS


def _levels(index: Array) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    neighbours, parents = [], []
    for level in range(LEVELS + 1):
        neighbours.append(_neighbours(index))
        if level == LEVELS:
            break
        coarse = index // 2
        span = coarse.max(axis=0) + 1 if len(coarse) else np.ones(3, np.int64)
        keys, parent = np.unique(np.ravel_multi_index(coarse.T, span), return_inverse=True)
        parents.append(parent.reshape(-1).astype(np.int64))
        index = np.stack(np.unravel_index(keys, span), axis=1)
    return tuple(neighbours), tuple(parents)


def _neighbours(index: Array) -> Array:
    """(n, 27) rows of ``index`` (unique, sorted) that touch each row; n where none does."""
    n = len(index)
    if not n:
        return np.zeros((0, 27), np.int64)
    low = index.min(axis=0) - 1
    span = index.max(axis=0) + 2 - low
    stride = np.array([span[1] * span[2], span[2], 1])
    keys = (index - low) @ stride
    wanted = keys[:, None] + _OFFSETS @ stride
    if int(np.prod(span)) > MAX_TABLE:
        at = np.minimum(np.searchsorted(keys, wanted), n - 1)
        return np.where(keys[at] == wanted, at, n)
    place = np.full(int(np.prod(span)), n, np.int32)
    place[keys] = np.arange(n)
    return place[wanted].astype(np.int64)


def input_names() -> list[str]:
    """Names of the ONNX graph's inputs, in the order of ``flat_inputs``."""
    return [
        "features",
        "ray",
        "ray_path",
        "weight",
        *(f"neighbours{k}" for k in range(LEVELS + 1)),
        *(f"parent{k}" for k in range(LEVELS)),
        "members",
        *(f"children{k}" for k in range(LEVELS)),
    ]


def flat_inputs(encoded: Encoded) -> list[Array]:
    """Return the arrays of ``encoded`` in the order of ``input_names``."""
    return [
        encoded.features,
        encoded.ray,
        encoded.ray_path,
        encoded.weight,
        *encoded.neighbours,
        *encoded.parent,
        encoded.members,
        *encoded.children,
    ]
