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
from gcar_deploy.tubes.pairing import Pairing, nearest_of_runs, paired
from gcar_deploy.types import Array, Points, Scalars

#: a tube seen this much end-on is treated as if at this sine of the angle to the ray.
MIN_SINE = 0.2


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
    first : (g,) first entry of each pixel; entries are sorted by pixel
    group : (e,) number of the entry's pixel among those of ``first``
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
    first: Array
    group: Array
    pairing: Pairing

    def totals(self) -> Scalars:
        """(g,) path length of each pixel that a tube covers, mm; pixel[first] says which."""
        total: Array = np.bincount(self.group, self.path_mm, minlength=len(self.first))
        return total

    def image(self, shape: tuple[int, int]) -> Array:
        """(rows, cols) float64 path length, mm."""
        image: Array = np.bincount(self.pixel, self.path_mm, minlength=shape[0] * shape[1])
        return image.reshape(shape)


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
        a, b = pixels[tubes.first], pixels[tubes.second]
        ahead = (depth[tubes.first] > 1.0) & (depth[tubes.second] > 1.0)
        wide = np.maximum(reach[tubes.first], reach[tubes.second])
        pairing = paired((a, b), wide, ahead, tubes.branch, (carm.rows, carm.columns))
        pairing = dataclasses.replace(pairing, corner=pixels, reach=reach)
    # The nearest of each run in single precision; what is kept is worked out in double.
    start = pixels.astype(np.float32)[tubes.first]
    along = (pixels[tubes.second] - pixels[tubes.first]).astype(np.float32)
    unit = along / np.maximum(np.einsum("ij,ij->i", along, along), np.float32(1e-12))[:, None]
    table = np.ascontiguousarray(np.concatenate([start, along, unit], axis=1).T)
    x0, y0, dx, dy, ux, uy = (column[pairing.segment] for column in table)
    x, y = pairing.col - x0, pairing.row - y0
    t = np.clip(x * ux + y * uy, 0.0, 1.0)
    keep = nearest_of_runs(pairing, (x - t * dx) ** 2 + (y - t * dy) ** 2)
    return _crossed(tubes, pairing, keep, (pixels, depth, per_mm, reach), box_px)


def _crossed(
    tubes: Tubes,
    pairing: Pairing,
    keep: Array,
    projected: tuple[Array, Scalars, Scalars, Scalars],
    box_px: float,
) -> Footprint:
    pixels, depth, per_mm, reach = projected
    pixel, segment = pairing.pixel[keep], pairing.segment[keep]
    i, j = tubes.first[segment], tubes.second[segment]
    a, b = pixels[tubes.first], pixels[tubes.second]
    step = b - a
    inverse = 1.0 / np.maximum(np.einsum("ij,ij->i", step, step), 1e-12)
    x, y = pairing.col[keep] - a[segment, 0], pairing.row[keep] - a[segment, 1]
    dx, dy = step[segment, 0], step[segment, 1]
    t = np.clip((x * dx + y * dy) * inverse[segment], 0.0, 1.0)
    x -= t * dx
    y -= t * dy
    distance = np.sqrt(x * x + y * y)
    near = distance < reach[i] + t * (reach[j] - reach[i])
    pixel, segment, i, j, t, x, y, distance = (
        value[near] for value in (pixel, segment, i, j, t, x, y, distance)
    )
    scale = per_mm[i] + t * (per_mm[j] - per_mm[i])
    radius = np.exp(tubes.log_radius[i] + t * (tubes.log_radius[j] - tubes.log_radius[i])) * scale
    length, d_distance, d_radius = box_chord(distance, radius, box_px)
    begins, finishes = _is_end(tubes, -1), _is_end(tubes, 1)
    stretch = _inverse_sine(tubes.points_mm, pixels, per_mm, begins, finishes)
    beyond = ((t <= 0) & begins[i]) | ((t >= 1) & finishes[j])
    to_mm = np.where(beyond, 1.0, stretch[i] + t * (stretch[j] - stretch[i])) / scale
    path = length * to_mm
    middle = depth[i] + t * (depth[j] - depth[i])
    first = np.flatnonzero(np.concatenate([[True], pixel[1:] != pixel[:-1]])[: len(pixel)])
    crossings = np.diff(np.append(first, len(pixel)))
    group = np.repeat(np.arange(len(first)), crossings)
    factor = _union_factor(first, crossings, middle, path)
    path = path * factor
    to_mm = to_mm * factor
    return Footprint(
        pixel=pixel,
        segment=segment,
        t=t,
        path_mm=path,
        d_distance=d_distance * to_mm,
        d_log_radius=d_radius * radius * to_mm,
        normal=np.stack([x, y], axis=1) / np.maximum(distance, 1e-9)[:, None],
        crossings=crossings[group],
        first=first,
        group=group,
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


def _inverse_sine(
    points: Points, pixels: Array, per_mm: Scalars, begins: Array, finishes: Array
) -> Scalars:
    """(n,) one over the sine between vessel and ray at each branch point.

    Taken between a point's neighbours and interpolated along segments, so that the path is
    continuous where two segments meet: a pixel there may count for either.
    """
    index = np.arange(len(pixels))
    before, after = index - ~begins, index + ~finishes
    chord, shift = points[after] - points[before], pixels[after] - pixels[before]
    length2 = np.einsum("ij,ij->i", chord, chord)
    seen2 = np.einsum("ij,ij->i", shift, shift)
    scale = 0.5 * (per_mm[before] + per_mm[after])
    sine = np.sqrt(seen2 / np.maximum(scale * scale * length2, 1e-18))
    return 1.0 / np.clip(sine, MIN_SINE, 1.0)


def _is_end(tubes: Tubes, side: int) -> Array:
    """(n,) whether a branch point is the first (side -1) or last (side 1) of its branch."""
    point = np.arange(len(tubes.point_branch))
    neighbour = np.clip(point + side, 0, len(point) - 1)
    out: Array = (tubes.point_branch[neighbour] != tubes.point_branch) | (neighbour == point)
    return out


def _union_factor(first: Array, count: Array, middle: Scalars, path: Scalars) -> Scalars:
    """Per entry: (length of the union of a pixel's intervals) / (their sum)."""
    factor = np.ones(len(path))
    at = first[count == 2]
    one, two = path[at], path[at + 1]
    both = one + two
    # Overlap of two intervals: what their halves reach beyond the distance of their middles.
    shared = 0.5 * both - np.abs(middle[at + 1] - middle[at])
    shared = np.clip(shared, 0.0, np.minimum(one, two))
    factor[at] = factor[at + 1] = (both - shared) / np.maximum(both, 1e-12)
    more = count > 2
    if more.any():
        start, size = first[more], count[more]
        entries = np.repeat(start - np.cumsum(size) + size, size) + np.arange(size.sum())
        group = np.repeat(np.arange(len(size)), size)
        factor[entries] = _union_share(group, middle[entries], path[entries])
    return factor


def _union_share(group: Array, middle: Scalars, path: Scalars) -> Scalars:
    """Per entry: length of the union of a group's intervals over their sum; by sorting."""
    order = np.lexsort((middle - 0.5 * path, group))
    p = group[order]
    start = (middle - 0.5 * path)[order]
    stop = start + path[order]
    new = np.ones(len(p), bool)
    new[1:] = p[1:] != p[:-1]
    # Running maximum of the stops inside each pixel, by shifting pixels far apart in depth.
    base = p * 1e6
    reached = np.maximum.accumulate(stop + base) - base
    before = np.full(len(p), -np.inf)
    before[1:] = reached[:-1]
    before[new] = -np.inf
    added = np.maximum(stop - np.maximum(start, before), 0.0)
    union = np.bincount(p, added) / np.maximum(np.bincount(p, path[order]), 1e-12)
    return union[group]
