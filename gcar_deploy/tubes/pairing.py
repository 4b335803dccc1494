"""Which pixels a tube may cover: segments paired with the pixels near them.

Pairs are kept from step to step while the tubes move little, and grouped into runs (one crossing
of one branch by one ray), of which the nearest segment counts.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.types import Array, Scalars

#: tubes may move and grow by this much before their pixels are paired anew, pixels.
MARGIN_PX = 1.0
#: a pixel counts for a segment where its foot lies this share of the reach beyond the segment's
#: ends, or within twice what the bend there opens towards the outside
LEAST_OVERLAP = 0.15
BEND_OVERLAP = 2.0
#: segments of one branch further apart than this in order, beyond as many as fit into half the
#: reach, are separate crossings of a ray.
RUN_GAP = 3


@dataclasses.dataclass(frozen=True, eq=False)
class Pairing:
    """Pixels near each segment.

    Attributes
    ----------
    pixel, segment : (q,) flat pixel and segment, sorted by pixel, then segment
    row, col : (q,) float32, of the pixel
    run : (q,) number of the run each pair belongs to
    first : (runs,) first pair of each run
    corner, reach : (n, 2), (n,) projected points and reach (px) the pairs were made for
    margin : float, px
    """

    pixel: Array
    segment: Array
    row: Scalars
    col: Scalars
    run: Array
    first: Array
    corner: Array
    reach: Scalars
    margin: float

    def fits(self, pixels: Array, reach: Scalars) -> bool:
        """Whether tubes at these pixels, with this reach, lie within the margin."""
        if len(pixels) != len(self.corner):
            return False
        move = np.abs(pixels - self.corner).max(axis=1) + np.maximum(reach - self.reach, 0.0)
        return bool(move.max(initial=0.0) <= self.margin)


def paired(
    ends: tuple[Array, Array],
    reach: Scalars,
    ahead: Array,
    branch: Array,
    shape: tuple[int, int],
) -> Pairing:
    """Pair segments with pixels.

    Parameters
    ----------
    ends : (s, 2) first and (s, 2) second ends of the segments, (col, row)
    reach : (s,) pixels
    ahead : (s,) bool, whether the segment lies in front of the source
    branch : (s,) branch of each segment, in order
    shape : rows, columns of the picture

    Returns
    -------
    Pairing without ``corner`` and ``reach``, which are the caller's
    """
    a, b = ends
    wide = reach + MARGIN_PX
    row, col, segment = _near_pixels(a, b, wide, ahead, branch, shape)
    along = b - a
    inverse = 1.0 / np.maximum(np.einsum("ij,ij->i", along, along), 1e-12)
    table = np.concatenate([a, along, inverse[:, None], (wide**2)[:, None]], axis=1)
    x0, y0, dx, dy, inv, most = (c[segment] for c in np.ascontiguousarray(table.T, np.float32))
    x, y = col - x0, row - y0
    t = np.clip((x * dx + y * dy) * inv, np.float32(0), np.float32(1))
    x -= t * dx
    y -= t * dy
    distance2 = x * x + y * y
    near = np.flatnonzero(distance2 < most)
    near = near[_by_pixel(row[near], col[near])]
    pixel, segment = row[near] * shape[1] + col[near], segment[near]
    distance = np.sqrt(distance2[near])
    new = np.ones(len(pixel), bool)
    own = branch[segment]
    # Short segments (seen end-on) leave wider gaps in between, of those whose foot lies elsewhere.
    gap = RUN_GAP + 0.5 * wide / np.maximum(np.sqrt(np.einsum("ij,ij->i", along, along)), 1e-6)
    new[1:] = (
        (pixel[1:] != pixel[:-1])
        | (own[1:] != own[:-1])
        | (segment[1:] - segment[:-1] > gap[segment[1:]])
    )
    run = np.cumsum(new) - 1
    if len(run):
        # Neighbours move together: one that lies further by the margin stays further.
        best = np.minimum.reduceat(distance, np.flatnonzero(new))
        close = distance <= best[run] + np.float32(MARGIN_PX)
        pixel, segment, run = pixel[close], segment[close], run[close]
    first = np.flatnonzero(np.concatenate([[True], run[1:] != run[:-1]])[: len(run)])
    down = pixel // shape[1]
    return Pairing(
        pixel=pixel,
        segment=segment,
        row=down.astype(np.float32),
        col=(pixel - down * shape[1]).astype(np.float32),
        run=run,
        first=first,
        corner=np.zeros((0, 2)),
        reach=np.zeros(0),
        margin=MARGIN_PX,
    )


def nearest_of_runs(pairing: Pairing, distance2: Scalars) -> Array:
    """Keep one pair per pixel and run of neighbouring segments: the nearest, the first of ties."""
    if not len(distance2):
        return np.zeros(0, np.int64)
    best = np.minimum.reduceat(distance2, pairing.first)
    hit = np.flatnonzero(distance2 <= best[pairing.run])
    run = pairing.run[hit]
    new = np.ones(len(run), bool)
    new[1:] = run[1:] != run[:-1]
    return hit[new]


def _by_pixel(row: Array, col: Array) -> Array:
    """Order by row, then column, then as given; two radix sorts, since no picture is that wide."""
    order = np.argsort(col.astype(np.uint16), kind="stable")
    return order[np.argsort(row.astype(np.uint16)[order], kind="stable")]


def _near_pixels(
    a: Array, b: Array, wide: Scalars, ahead: Array, branch: Array, shape: tuple[int, int]
) -> tuple[Array, Array, Array]:
    """Pair segments with the pixels whose foot on them lies between or little beyond their ends.

    Such pixels fill a rectangle along each segment, found row by row: row, col, segment.
    """
    length = np.linalg.norm(b - a, axis=1)
    unit = np.where(length[:, None] > 1e-9, (b - a) / np.maximum(length, 1e-9)[:, None], [1.0, 0.0])
    low, high = _beyond(unit, wide, branch)
    low, high = -low, length + high
    ux, uy = unit.T
    ends = np.stack([low * uy, high * uy]) + a[:, 1]
    top = _whole(np.ceil(ends.min(axis=0) - wide * np.abs(ux)), shape[0])
    height = _whole(np.floor(ends.max(axis=0) + wide * np.abs(ux)) + 1, shape[0]) - top
    height = np.where(ahead, np.maximum(height, 0), 0)
    owner = np.repeat(np.arange(len(a)), height)
    line = np.arange(len(owner)) - np.repeat(np.cumsum(height) - height - top, height)
    y = line - a[owner, 1]
    # Both the foot and the distance grow linearly along a row: two stretches of columns.
    ux, uy, w = ux[owner], uy[owner], wide[owner]
    first, last = _stretch(low[owner] - y * uy, high[owner] - y * uy, ux)
    left, right = _stretch(y * ux - w, y * ux + w, uy)
    x = a[owner, 0]
    start = _whole(np.ceil(x + np.maximum(first, left)), shape[1])
    count = np.maximum(_whole(np.floor(x + np.minimum(last, right)) + 1, shape[1]) - start, 0)
    which = np.repeat(np.arange(len(owner)), count)
    col = np.arange(len(which)) - np.repeat(np.cumsum(count) - count - start, count)
    return line[which], col, owner[which]


def _beyond(unit: Array, wide: Scalars, branch: Array) -> tuple[Scalars, Scalars]:
    """How far beyond each end of a segment the foot of its pixels may lie, px.

    All the way to the reach at the ends of a branch, which are round. In between neighbours take
    over, but on the outside of a bend no foot falls between them.
    """
    bend = 0.5 * np.linalg.norm(unit[1:] - unit[:-1], axis=1)
    share = np.minimum(LEAST_OVERLAP + BEND_OVERLAP * bend, 1.0)
    share[branch[1:] != branch[:-1]] = 1.0
    low = wide * np.concatenate([[1.0], share])[: len(wide)]
    high = wide * np.concatenate([share, [1.0]])[: len(wide)]
    return np.minimum(low + MARGIN_PX, wide), np.minimum(high + MARGIN_PX, wide)


def _stretch(low: Scalars, high: Scalars, slope: Scalars) -> tuple[Scalars, Scalars]:
    """Where ``low <= slope x <= high``: from, to."""
    inverse = 1.0 / np.where(np.abs(slope) < 1e-9, 1e-9, slope)
    one, two = low * inverse, high * inverse
    return np.minimum(one, two), np.maximum(one, two)


def _whole(values: Scalars, limit: int) -> Array:
    """Whole numbers within 0 .. limit; NaN to 0."""
    return np.clip(np.nan_to_num(values, nan=0.0), 0, limit).astype(np.int64)
