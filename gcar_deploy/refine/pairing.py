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
#: segments of one branch further apart than this in order are separate crossings of a ray.
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
    row, col, segment = _near_pixels(a, b, wide, ahead, shape)
    along = b - a
    inverse = 1.0 / np.maximum(np.einsum("ij,ij->i", along, along), 1e-12)
    table = np.concatenate([a, along, inverse[:, None], (wide**2)[:, None]], axis=1)
    x0, y0, dx, dy, inv, most = (c[segment] for c in np.ascontiguousarray(table.T, np.float32))
    x, y = col - x0, row - y0
    t = np.clip((x * dx + y * dy) * inv, np.float32(0), np.float32(1))
    distance2 = (x - t * dx) ** 2 + (y - t * dy) ** 2
    near = distance2 < most
    pixel, segment, distance2 = (row * shape[1] + col)[near], segment[near], distance2[near]
    # Segments come in order, so a stable sort by pixel alone sorts by pixel, then segment.
    order = np.argsort(pixel, kind="stable")
    pixel, segment, distance = pixel[order], segment[order], np.sqrt(distance2[order])
    new = np.ones(len(pixel), bool)
    own = branch[segment]
    new[1:] = (
        (pixel[1:] != pixel[:-1]) | (own[1:] != own[:-1]) | (segment[1:] - segment[:-1] > RUN_GAP)
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


def _near_pixels(
    a: Array, b: Array, reach: Scalars, ahead: Array, shape: tuple[int, int]
) -> tuple[Array, Array, Array]:
    """Pair segments with the pixels of their boxes: row, col, segment."""
    limit = np.array([shape[1], shape[0]])
    big = 1e6
    low = np.clip(np.nan_to_num(np.minimum(a, b) - reach[:, None], nan=big), -big, big)
    high = np.clip(np.nan_to_num(np.maximum(a, b) + reach[:, None], nan=-big), -big, big)
    low_i = np.clip(np.ceil(low).astype(np.int64), 0, limit)
    size = np.maximum(np.clip(np.floor(high).astype(np.int64) + 1, 0, limit) - low_i, 0)
    # Row by row: each row of a box is a stretch of columns.
    height = size[:, 1] * (size[:, 0] > 0) * ahead
    owner = np.repeat(np.arange(len(a)), height)
    line = low_i[owner, 1] + np.arange(len(owner)) - np.repeat(np.cumsum(height) - height, height)
    count = size[owner, 0]
    which = np.repeat(np.arange(len(owner)), count)
    col = np.arange(len(which)) + np.repeat(low_i[owner, 0] - np.cumsum(count) + count, count)
    return line[which], col, owner[which]
