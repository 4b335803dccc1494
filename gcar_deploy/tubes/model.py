"""Analytic projection of a tree of tubes: path length per pixel, and its derivatives.

A round tube of radius r seen at distance rho from its projected axis is crossed along
``2 sqrt(r^2 - rho^2) / sin(alpha)``, alpha the angle between ray and axis. Averaged over a box of
width b across the axis this has a closed form with bounded derivatives,

    L = [G(rho + b/2) - G(rho - b/2)] / b,   G(x) = x sqrt(r^2 - x^2) + r^2 asin(x / r).

A pixel's box and any blur of the picture enter through b with the same variance (b^2 / 12).
Where tubes overlap in space, a ray's intervals through them are united, not added.

A mask tells no paths: its width tells the chord of a round section, however slanted the tube, and
of tubes behind one another it shows the widest.
"""

from __future__ import annotations

import dataclasses
from typing import Literal, TypeAlias

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.pairing import Pairing, paired
from gcar_deploy.types import Array, Points, Scalars

#: a tube seen this much end-on is treated as if at this sine of the angle to the ray.
MIN_SINE = 0.2
#: what a picture tells of tubes, in mm: the path of each ray through them all, or the chord that
#: the width of the widest tells
Shown: TypeAlias = Literal["path", "width"]
#: paths that are equal in so many digits, mm, are ties: branches that share a node may be as wide
#: as each other beyond it, and rounding would choose between them
TIE_DIGITS = 9


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

    Entries are sorted by segment; those beyond the reach of their tube are 0.

    Attributes
    ----------
    t : (e,) 0 .. 1, where along the segment
    path_mm : (e,) contribution, the union factor included; 0 of what a mask hides
    d_axis : (2, e) derivative by the place of the axis, (col, row), mm per px
    d_log_radius : (e,) derivative by log radius, mm
    crossings : (e,) number of entries above 0 that share the pixel
    pairing : Pairing it was made with
    """

    t: Scalars
    path_mm: Scalars
    d_axis: Array
    d_log_radius: Scalars
    crossings: Array
    pairing: Pairing

    @property
    def pixel(self) -> Array:
        """(e,) flat pixel index."""
        return self.pairing.pixel

    @property
    def segment(self) -> Array:
        """(e,) segment."""
        return self.pairing.segment

    @property
    def covered(self) -> Array:
        """(g,) the distinct pixels, sorted."""
        return self.pairing.covered

    @property
    def group(self) -> Array:
        """(e,) which of ``covered`` an entry's pixel is."""
        return self.pairing.group

    def totals(self) -> Scalars:
        """(g,) path length of each of the pixels ``covered``, mm."""
        total: Array = np.bincount(self.group, self.path_mm, minlength=len(self.covered))
        return total

    def image(self, shape: tuple[int, int]) -> Array:
        """(rows, cols) float64 path length, mm."""
        image = np.zeros(shape[0] * shape[1])
        image[self.covered] = self.totals()
        return image.reshape(shape)


def footprint(
    tubes: Tubes,
    carm: CArm,
    box_px: float,
    pairing: Pairing | None = None,
    shown: Shown = "path",
) -> Footprint:
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
    shown : what the picture tells of tubes
    """
    pixels, depth = carm.project(tubes.points_mm)
    per_mm = carm.px_per_mm(depth)
    reach = tubes.radius_mm * per_mm + 0.5 * box_px
    i, j = tubes.first, tubes.second
    if pairing is None or not pairing.fits(pixels, reach):
        segments = i, j, tubes.branch
        pairing = paired(pixels, reach, depth > 1.0, segments, (carm.rows, carm.columns))
    begins, finishes = _ends(tubes.point_branch)
    stretch = _inverse_sine(tubes.points_mm, pixels, per_mm, begins, finishes)
    step = pixels[j] - pixels[i]
    inverse = 1.0 / np.maximum(np.einsum("ij,ij->i", step, step), 1e-12)
    # What is linear along a segment, at its first point and the change to its second.
    linear = np.array([tubes.log_radius, per_mm, stretch, depth])
    # Beyond the ends of a branch caps are round: t there is at most 0, or at least 1.
    caps = [np.where(begins[i], 0.0, -1.0), np.where(finishes[j], 1.0, 2.0)]
    table = [*pixels[i].T, *step.T, inverse, *caps, *linear[:, i], *(linear[:, j] - linear[:, i])]
    x, y, dx, dy, inverse, low, high, *values = np.repeat(np.array(table), pairing.count, axis=1)
    log_radius, scale, stretch, middle = values[:4]
    x, y = pairing.col - x, pairing.row - y
    t = np.minimum(np.maximum((x * dx + y * dy) * inverse, 0.0), 1.0)
    x -= t * dx
    y -= t * dy
    for value, change in zip(values[:4], values[4:], strict=True):
        value += t * change
    distance = np.sqrt(x * x + y * y)
    radius = np.exp(log_radius) * scale
    length, d_distance, d_radius = box_chord(distance, radius, box_px)
    unslanted = (t <= low) | (t >= high) | (shown == "width")
    to_mm = np.where(unslanted, 1.0, stretch) / scale
    path = length * to_mm
    factor = _union_factor(pairing, middle, path) if shown == "path" else _widest(pairing, path)
    path *= factor
    to_mm *= factor
    crossings = np.bincount(pairing.group, path > 0, minlength=len(pairing.covered))
    # The distance shrinks when the axis moves towards the pixel.
    towards = d_distance * to_mm / -np.maximum(distance, 1e-9)
    return Footprint(
        t=t,
        path_mm=path,
        d_axis=np.array([x * towards, y * towards]),
        d_log_radius=d_radius * radius * to_mm,
        crossings=crossings[pairing.group],
        pairing=pairing,
    )


def box_chord(distance: Scalars, radius: Scalars, box: float) -> tuple[Scalars, Scalars, Scalars]:
    """Chord of a round section averaged over a box, and its derivatives.

    All lengths in one unit. Returns (length, by distance, by radius), each (n,).
    """
    # Not np.clip, whose call takes as long as the work.
    upper = np.minimum(np.maximum((distance + 0.5 * box) / radius, -1.0), 1.0)
    lower = np.minimum(np.maximum((distance - 0.5 * box) / radius, -1.0), 1.0)
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
    return 1.0 / np.minimum(np.maximum(sine, MIN_SINE), 1.0)


def _ends(point_branch: Array) -> tuple[Array, Array]:
    """(n,) whether a branch point is the first of its branch, and whether it is the last."""
    begins, finishes = np.ones((2, len(point_branch)), bool)
    begins[1:] = finishes[:-1] = point_branch[1:] != point_branch[:-1]
    return begins, finishes


def _union_factor(pairing: Pairing, middle: Scalars, path: Scalars) -> Scalars:
    """Per entry: (length of the union of a pixel's intervals) / (their sum)."""
    factor = np.ones(len(path))
    a, b = pairing.double
    one, two = path[a], path[b]
    both = one + two
    # Overlap of two intervals: what their halves reach beyond the distance of their middles.
    shared = 0.5 * both - np.abs(middle[b] - middle[a])
    shared = np.minimum(np.maximum(shared, 0.0), np.minimum(one, two))
    factor[a] = factor[b] = (both - shared) / np.maximum(both, 1e-12)
    more = pairing.several
    if len(more):
        factor[more] = _union_share(pairing.several_group, middle[more], path[more])
    return factor


def _widest(pairing: Pairing, path: Scalars) -> Scalars:
    """Per entry: 1 for the longest of its pixel, the first of ties, 0 for what that hides."""
    factor = np.ones(len(path))
    a, b = pairing.double
    hidden = path[b] > path[a] + 10.0**-TIE_DIGITS
    factor[a], factor[b] = ~hidden, hidden
    more = pairing.several
    group = pairing.several_group
    order = np.lexsort((-np.round(path[more], TIE_DIGITS), group))
    factor[more] = 0.0
    factor[more[order[np.flatnonzero(np.diff(group[order], prepend=-1))]]] = 1.0
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
