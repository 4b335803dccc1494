"""Analytic projection of a tree of tubes: path length per pixel, and its derivatives.

A round tube of radius r seen at distance rho from its projected axis is crossed along
``2 sqrt(r^2 - rho^2) / sin(alpha)``, alpha the angle between ray and axis. Averaged over a box of
width b across the axis this has a closed form with bounded derivatives,

    L = [G(rho + b/2) - G(rho - b/2)] / b,   G(x) = x sqrt(r^2 - x^2) + r^2 asin(x / r).

A pixel's box and any blur of the picture enter through b with the same variance (b^2 / 12).
Where tubes overlap in space, a ray's intervals through them are united, not added.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Points, Scalars

#: a tube seen this much end-on is treated as if at this sine of the angle to the ray.
MIN_SINE = 0.2
#: tubes may move and grow by this much before their pixels are paired anew, pixels.
MARGIN_PX = 1.0
#: segments of one branch further apart than this in order are separate crossings of a ray.
RUN_GAP = 3


@dataclasses.dataclass(frozen=True, eq=False)
class Tubes:
    """A tree as flat arrays; joined branch ends share a position, not a radius.

    Attributes
    ----------
    positions_mm : (p, 3) distinct positions
    log_radius : (n,) log of the radius in mm, one per branch point
    owner : (n,) position of each branch point
    first, second : (s,) branch points of each segment
    branch : (s,) branch of each segment
    point_branch : (n,) branch of each branch point
    """

    positions_mm: Points
    log_radius: Scalars
    owner: Array
    first: Array
    second: Array
    branch: Array
    point_branch: Array

    @property
    def points_mm(self) -> Points:
        """(n, 3) position of each branch point."""
        return self.positions_mm[self.owner]

    @property
    def radius_mm(self) -> Scalars:
        """(n,) radius of each branch point."""
        return np.exp(self.log_radius)


def tubes_of(tree: Tree) -> Tubes:
    """Flatten a tree."""
    owner: list[Array] = []
    positions = [tree.nodes_mm]
    used = len(tree.nodes_mm)
    for branch in tree.branches:
        inner = len(branch) - 2
        index = np.concatenate([[branch.start], used + np.arange(inner), [branch.end]])
        owner.append(index.astype(np.int64))
        positions.append(branch.points_mm[1:-1])
        used += inner
    point_branch = tree.branch_index()
    n = len(point_branch)
    inner_step = np.flatnonzero(point_branch[1:] == point_branch[:-1]) if n else np.zeros(0, int)
    return Tubes(
        positions_mm=np.concatenate(positions),
        log_radius=np.log(tree.radii()),
        owner=np.concatenate(owner) if owner else np.zeros(0, np.int64),
        first=inner_step,
        second=inner_step + 1,
        branch=point_branch[inner_step],
        point_branch=point_branch,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Footprint:
    """Where tubes fall in one picture: one entry per pixel and crossing.

    Attributes
    ----------
    pixel : (e,) flat pixel index
    segment : (e,) segment
    t : (e,) 0 .. 1, where along the segment
    path_mm : (e,) contribution, the union factor included
    d_distance : (e,) derivative by distance from the axis, mm per px
    d_log_radius : (e,) derivative by log radius, mm
    normal : (e, 2) unit vector (col, row) from the axis to the pixel
    crossings : (e,) number of entries that share the pixel
    pairing : Pairing it was made with
    """

    pixel: Array
    segment: Array
    t: Scalars
    path_mm: Scalars
    d_distance: Scalars
    d_log_radius: Scalars
    normal: Array
    crossings: Array
    pairing: Pairing

    def image(self, shape: tuple[int, int]) -> Array:
        """(rows, cols) float64 path length, mm."""
        total = np.bincount(self.pixel, self.path_mm, minlength=shape[0] * shape[1])
        return total.reshape(shape)


@dataclasses.dataclass(frozen=True, eq=False)
class Pairing:
    """Pixels near each segment, kept from step to step while the tubes move little.

    Attributes
    ----------
    pixel, segment : (q,) flat pixel and segment, sorted by pixel, then segment
    row, col : (q,) float64, of the pixel
    run : (q,) number of the run (one crossing of one branch) each pair belongs to
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


def footprint(tubes: Tubes, carm: CArm, box_px: float, pairing: Pairing | None = None) -> Footprint:
    """Project tubes into one view.

    Parameters
    ----------
    tubes : Tubes
    carm : CArm
        Its rows and columns bound the picture.
    box_px : float
        Width of the averaging box across a vessel, pixels, above 0.
    pairing : Pairing or None
        From an earlier call; used where the tubes have moved little since.
    """
    pixels, depth = carm.project(tubes.points_mm)
    per_mm = np.sqrt(np.prod(carm.focal_px)) / np.maximum(depth, 1.0)
    reach = tubes.radius_mm * per_mm + 0.5 * box_px
    if pairing is None or not pairing.fits(pixels, reach):
        pairing = _paired(tubes, carm, pixels, depth, reach)
    q = pairing
    a, b = pixels[tubes.first], pixels[tubes.second]
    along = b - a
    inverse = 1.0 / np.maximum(np.einsum("ij,ij->i", along, along), 1e-12)
    dx, dy = along[:, 0][q.segment], along[:, 1][q.segment]
    x, y = q.col - a[:, 0][q.segment], q.row - a[:, 1][q.segment]
    t = np.clip((x * dx + y * dy) * inverse[q.segment], 0.0, 1.0)
    x -= t * dx
    y -= t * dy
    distance2 = x * x + y * y
    keep = _nearest_of_runs(q, distance2)
    ri, rj = reach[tubes.first][q.segment[keep]], reach[tubes.second][q.segment[keep]]
    distance = np.sqrt(distance2[keep])
    near = distance < ri + t[keep] * (rj - ri)
    keep, distance = keep[near], distance[near]
    away = np.stack([x[keep], y[keep]], axis=1)
    return _crossed(tubes, q, keep, t[keep], away, distance, (pixels, depth, per_mm), box_px)


def _crossed(
    tubes: Tubes,
    pairing: Pairing,
    keep: Array,
    t: Scalars,
    away: Array,
    distance: Scalars,
    projected: tuple[Array, Scalars, Scalars],
    box_px: float,
) -> Footprint:
    pixels, depth, per_mm = projected
    pixel, segment = pairing.pixel[keep], pairing.segment[keep]
    i, j = tubes.first[segment], tubes.second[segment]
    scale = per_mm[i] + t * (per_mm[j] - per_mm[i])
    radius = np.exp(tubes.log_radius[i] + t * (tubes.log_radius[j] - tubes.log_radius[i])) * scale
    length, d_distance, d_radius = box_chord(distance, radius, box_px)
    to_mm = _inverse_sine(tubes, pixels, per_mm)[segment]
    beyond = ((t <= 0) & _is_end(tubes, i, -1)) | ((t >= 1) & _is_end(tubes, j, 1))
    to_mm = np.where(beyond, 1.0, to_mm) / scale
    path = length * to_mm
    middle = depth[i] + t * (depth[j] - depth[i])
    factor, crossings = _union_factor(pixel, middle, path)
    to_mm = to_mm * factor
    return Footprint(
        pixel=pixel,
        segment=segment,
        t=t,
        path_mm=path * factor,
        d_distance=d_distance * to_mm,
        d_log_radius=d_radius * radius * to_mm,
        normal=away / np.maximum(distance, 1e-9)[:, None],
        crossings=crossings,
        pairing=pairing,
    )


def box_chord(distance: Scalars, radius: Scalars, box: float) -> tuple[Scalars, Scalars, Scalars]:
    """Chord of a round section averaged over a box, and its derivatives.

    All lengths in one unit. Returns (length, by distance, by radius), each (n,).
    """
    upper = np.clip((distance + 0.5 * box) / radius, -1.0, 1.0)
    lower = np.clip((distance - 0.5 * box) / radius, -1.0, 1.0)
    root_u, root_l = np.sqrt(1 - upper * upper), np.sqrt(1 - lower * lower)
    angle = np.arcsin(upper) - np.arcsin(lower)
    length = radius * radius * (upper * root_u - lower * root_l + angle) / box
    return length, 2 * radius * (root_u - root_l) / box, 2 * radius * angle / box


def _paired(tubes: Tubes, carm: CArm, pixels: Array, depth: Scalars, reach: Scalars) -> Pairing:
    a, b = pixels[tubes.first], pixels[tubes.second]
    ahead = (depth[tubes.first] > 1.0) & (depth[tubes.second] > 1.0)
    wide = np.maximum(reach[tubes.first], reach[tubes.second]) + MARGIN_PX
    row, col, segment = _near_pixels(a, b, wide, ahead, carm)
    x, y = col - a[segment, 0], row - a[segment, 1]
    along = b - a
    dx, dy = along[segment, 0], along[segment, 1]
    t = np.clip((x * dx + y * dy) / np.maximum(dx * dx + dy * dy, 1e-12), 0.0, 1.0)
    near = (x - t * dx) ** 2 + (y - t * dy) ** 2 < wide[segment] ** 2
    row, col, segment = row[near], col[near], segment[near]
    pixel = row * carm.columns + col
    # One integer key sorts by pixel, then segment.
    order = np.argsort(pixel * np.int64(len(a) + 1) + segment, kind="stable")
    pixel, segment = pixel[order], segment[order]
    new = np.ones(len(pixel), bool)
    new[1:] = (
        (pixel[1:] != pixel[:-1])
        | (tubes.branch[segment[1:]] != tubes.branch[segment[:-1]])
        | (segment[1:] - segment[:-1] > RUN_GAP)
    )
    return Pairing(
        pixel=pixel,
        segment=segment,
        row=row[order].astype(np.float64),
        col=col[order].astype(np.float64),
        run=np.cumsum(new) - 1,
        first=np.flatnonzero(new),
        corner=pixels,
        reach=reach,
        margin=MARGIN_PX,
    )


def _near_pixels(
    a: Array, b: Array, reach: Scalars, ahead: Array, carm: CArm
) -> tuple[Array, Array, Array]:
    """Pair segments with the pixels of their boxes: row, col, segment."""
    limit = np.array([carm.columns, carm.rows])
    big = 1e6
    low = np.clip(np.nan_to_num(np.minimum(a, b) - reach[:, None], nan=big), -big, big)
    high = np.clip(np.nan_to_num(np.maximum(a, b) + reach[:, None], nan=-big), -big, big)
    low_i = np.clip(np.ceil(low).astype(np.int64), 0, limit)
    size = np.maximum(np.clip(np.floor(high).astype(np.int64) + 1, 0, limit) - low_i, 0)
    count = size.prod(axis=1) * ahead
    segment = np.repeat(np.arange(len(a)), count)
    within = np.arange(len(segment)) - np.repeat(np.cumsum(count) - count, count)
    width = np.maximum(size[:, 0], 1)[segment]
    down = within // width
    return low_i[:, 1][segment] + down, low_i[:, 0][segment] + within - down * width, segment


def _nearest_of_runs(pairing: Pairing, distance2: Scalars) -> Array:
    """Keep one pair per pixel and run of neighbouring segments: the nearest, the first of ties."""
    if not len(distance2):
        return np.zeros(0, np.int64)
    best = np.minimum.reduceat(distance2, pairing.first)
    hit = np.flatnonzero(distance2 <= best[pairing.run])
    run = pairing.run[hit]
    new = np.ones(len(run), bool)
    new[1:] = run[1:] != run[:-1]
    return hit[new]


def _inverse_sine(tubes: Tubes, pixels: Array, per_mm: Scalars) -> Scalars:
    """(s,) one over the sine between each segment and its ray."""
    points = tubes.points_mm
    length = np.linalg.norm(points[tubes.second] - points[tubes.first], axis=1)
    seen = np.linalg.norm(pixels[tubes.second] - pixels[tubes.first], axis=1)
    scale = 0.5 * (per_mm[tubes.first] + per_mm[tubes.second])
    sine = seen / np.maximum(scale * length, 1e-9)
    return 1.0 / np.clip(sine, MIN_SINE, 1.0)


def _is_end(tubes: Tubes, point: Array, side: int) -> Array:
    """Whether a branch point is the first (side -1) or last (side 1) of its branch."""
    neighbour = np.clip(point + side, 0, len(tubes.point_branch) - 1)
    out: Array = (tubes.point_branch[neighbour] != tubes.point_branch[point]) | (neighbour == point)
    return out


def _union_factor(pixel: Array, middle: Scalars, path: Scalars) -> tuple[Scalars, Array]:
    """Per entry: (length of the union of a pixel's intervals) / (their sum), and their count."""
    order = np.lexsort((middle - 0.5 * path, pixel))
    p = pixel[order]
    start = (middle - 0.5 * path)[order]
    stop = start + path[order]
    new = np.ones(len(p), bool)
    new[1:] = p[1:] != p[:-1]
    group = np.cumsum(new) - 1
    count = np.bincount(group)
    # Running maximum of the stops inside each pixel, by shifting pixels far apart in depth.
    base = group * 1e6
    reached = np.maximum.accumulate(stop + base) - base
    before = np.full(len(p), -np.inf)
    before[1:] = reached[:-1]
    before[new] = -np.inf
    added = np.maximum(stop - np.maximum(start, before), 0.0)
    total = np.bincount(group, path[order])
    union = np.bincount(group, added)
    factor = np.empty(len(p))
    factor[order] = (union / np.maximum(total, 1e-12))[group]
    crossings = np.empty(len(p), np.int64)
    crossings[order] = count[group]
    return factor, crossings
