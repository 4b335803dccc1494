"""Which pixels a tube may cover: each crossing of a branch by a ray with its nearest segment.

Kept from step to step while the tubes move little: neighbours move together, so that what is
nearest stays so but for pixels that lie between two of them, where either says nearly the same.
"""

from __future__ import annotations

import dataclasses
import functools

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
#: of squared distances, of the 31 that single precision has
RANK_BITS = 22


@dataclasses.dataclass(frozen=True, eq=False)
class Pairing:
    """Crossings: pixels within the margin of a branch's reach, with the nearest segment there.

    Attributes
    ----------
    pixel, segment : (e,) flat pixel and segment, sorted by segment, then pixel
    row, col : (e,) of the pixel
    count : (s,) crossings of each segment
    covered : (g,) the distinct pixels, sorted
    group : (e,) which of ``covered`` a crossing's pixel is
    double : (2, k) crossings that share their pixel with one other
    several : (m,) crossings that share theirs with more, sorted by pixel
    several_group : (m,) number of their pixel among those of such crossings
    corner, reach : (n, 2), (n,) projected points and reach (px) the crossings were found for
    """

    pixel: Array
    segment: Array
    row: Scalars
    col: Scalars
    count: Array
    covered: Array
    group: Array
    double: Array
    several: Array
    several_group: Array
    corner: Array
    reach: Scalars

    @functools.cached_property
    def starts(self) -> tuple[Array, Array]:
        """Segments that have crossings, and the first crossing of each."""
        some = np.flatnonzero(self.count)
        return some, (np.cumsum(self.count) - self.count)[some]

    def fits(self, pixels: Array, reach: Scalars) -> bool:
        """Whether tubes at these pixels, with this reach, lie within the margin."""
        if len(pixels) != len(self.corner):
            return False
        move = np.abs(pixels - self.corner).max(axis=1) + np.maximum(reach - self.reach, 0.0)
        return bool(move.max(initial=0.0) <= MARGIN_PX)


def paired(
    pixels: Array,
    reach: Scalars,
    ahead: Array,
    segments: tuple[Array, Array, Array],
    shape: tuple[int, int],
) -> Pairing:
    """Pair pixels with segments.

    Parameters
    ----------
    pixels : (n, 2) projected points, (col, row)
    reach : (n,) pixels
    ahead : (n,) bool, whether the point lies in front of the source
    segments : (s,) first point, second point and branch of each segment, in order
    shape : rows, columns of the picture
    """
    first, second, branch = segments
    a, b = pixels[first], pixels[second]
    wide = np.maximum(reach[first], reach[second]) + MARGIN_PX
    row, col, segment = _near_pixels(a, b, wide, ahead[first] & ahead[second], branch, shape)
    along = b - a
    inverse = 1.0 / np.maximum(np.einsum("ij,ij->i", along, along), 1e-12)
    table = np.concatenate([a, along, inverse[:, None], (wide**2)[:, None]], axis=1)
    many = np.bincount(segment, minlength=len(first))
    x, y, dx, dy, inv, most = np.repeat(table.T, many, axis=1)
    np.subtract(col, x, out=x)
    np.subtract(row, y, out=y)
    t = np.minimum(np.maximum((x * dx + y * dy) * inv, 0.0), 1.0)
    x -= t * dx
    y -= t * dy
    distance2 = x * x + y * y
    near = np.flatnonzero(distance2 < most)
    pixel, segment, rank = _by_pixel(
        row[near] * shape[1] + col[near], segment[near], distance2[near]
    )
    new = np.ones(len(pixel), bool)
    own = branch[segment]
    # Short segments (seen end-on) leave wider gaps in between, of those whose foot lies elsewhere.
    gap = RUN_GAP + 0.5 * wide / np.maximum(np.sqrt(np.einsum("ij,ij->i", along, along)), 1e-6)
    new[1:] = (
        (pixel[1:] != pixel[:-1])
        | (own[1:] != own[:-1])
        | (segment[1:] - segment[:-1] > gap[segment[1:]])
    )
    nearest = _nearest_of_runs(np.cumsum(new) - 1, rank)
    pixel, segment = pixel[nearest], segment[nearest]
    new = np.ones(len(pixel), bool)
    new[1:] = pixel[1:] != pixel[:-1]
    covered, group = pixel[new], np.cumsum(new) - 1
    # From the order of pixels to that of segments.
    order = np.argsort(segment.astype(np.uint16 if len(first) < 2**16 else int), kind="stable")
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    start = np.flatnonzero(new)
    shared = np.diff(np.append(start, len(pixel)))
    two, crowded = start[shared == 2], shared > 2
    pixel, segment = pixel[order], segment[order]
    down = pixel // shape[1]
    return Pairing(
        pixel=pixel,
        segment=segment,
        row=down.astype(np.float64),
        col=(pixel - down * shape[1]).astype(np.float64),
        count=np.bincount(segment, minlength=len(first)),
        covered=covered,
        group=group[order],
        double=np.stack([place[two], place[two + 1]]),
        several=place[crowded[group]],
        several_group=np.repeat(np.arange(np.count_nonzero(crowded)), shared[crowded]),
        corner=pixels,
        reach=reach,
    )


def _nearest_of_runs(run: Array, rank: Array) -> Array:
    """Find the nearest of each run, the first of ties, (runs,); runs are numbered in order."""
    if not len(run):
        return run
    best = np.full(run[-1] + 1, np.iinfo(np.int64).max)
    np.minimum.at(best, run, rank)
    hit = np.flatnonzero(rank == best[run])
    new = np.ones(len(hit), bool)
    new[1:] = run[hit[1:]] != run[hit[:-1]]
    return hit[new]


def _by_pixel(pixel: Array, segment: Array, distance2: Scalars) -> tuple[Array, Array, Array]:
    """Sort by pixel, then segment; distances become whole numbers of the same order.

    As digits of one number each, which sorts several times faster than an order is found. What lies
    beyond the joint of two segments is as far from either: some digits less than single precision
    has, so that rounding does not say which comes first.
    """
    of_segment = int(segment.max(initial=0)).bit_length()
    of_rank = min(62 - of_segment - int(pixel.max(initial=0)).bit_length(), RANK_BITS)
    # Floats above 0 have the order of their bits.
    bits = distance2.astype(np.float32).view(np.int32)
    rank = bits.astype(np.int64) >> (31 - of_rank)
    key = (((pixel << of_segment) | segment) << of_rank) | rank
    key.sort()
    rank = key & ((1 << of_rank) - 1)
    key >>= of_rank
    return key >> of_segment, key & ((1 << of_segment) - 1), rank


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
    return low, high


def _stretch(low: Scalars, high: Scalars, slope: Scalars) -> tuple[Scalars, Scalars]:
    """Where ``low <= slope x <= high``: from, to."""
    inverse = 1.0 / np.where(np.abs(slope) < 1e-9, 1e-9, slope)
    one, two = low * inverse, high * inverse
    return np.minimum(one, two), np.maximum(one, two)


def _whole(values: Scalars, limit: int) -> Array:
    """Whole numbers within 0 .. limit; NaN to 0."""
    # Comparisons with NaN are false.
    out: Array = np.where(values > 0, np.minimum(values, limit), 0).astype(np.int64)
    return out
