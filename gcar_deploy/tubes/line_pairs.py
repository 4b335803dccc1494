"""Pairs of places on the lines of two views that may show one point of a vessel.

A place of one view's line and a place of the other's in the same epipolar plane meet in a point.
All such pairs, joined where both places are neighbours on their lines, are a graph: every vessel
that both pictures show as a line is a way through it, and so is every ghost.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import plane_angles, reach_mm, triangulate
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.line_chains import stretches_of
from gcar_deploy.tubes.missed import MOST_DEVICE
from gcar_deploy.types import Array, Pixels, Points, Scalars

#: places of a line are so far apart, mm at the isocentre; those of a pair lie in planes so near, mm
STEP_MM, PLANE_MM = 0.7, 0.8
#: pairs whose point is farther from the middle of both views are no coronary vessel, mm
FARTHEST_MM = 150.0
#: pairs at most; and places of a view: lines along the planes pair each with each
MOST_PAIRS, MOST_PLACES = 60_000, 8_000
#: narrower lines have no width to compare, mm
LEAST_WIDTH_MM = 0.2


@dataclasses.dataclass(frozen=True, eq=False)
class Places:
    """The lines of one view, in steps.

    Attributes
    ----------
    pixels : (n, 2) col, row
    joined : (n, k) numbers of each place and of its neighbours, n where there are no more
    length_mm : (n,) of line that each stands for, at the isocentre
    width_mm : (n,) of the vessel there, at the isocentre
    plane_mm : (n,) epipolar plane
    tip_mm : (n,) along the line to its nearest free end
    """

    pixels: Pixels
    joined: Array
    length_mm: Scalars
    width_mm: Scalars
    plane_mm: Scalars
    tip_mm: Scalars

    def __len__(self) -> int:
        return len(self.pixels)


@dataclasses.dataclass(frozen=True, eq=False)
class LinePairs:
    """Pairs of places, and the steps between them.

    Attributes
    ----------
    places : of both views
    at : (2, n) place of each pair in either view
    points_mm : (n, 3) where their rays meet
    radius_mm : (n,) of the narrower of both lines, at that point
    misfit : (n,) log of the ratio of both widths
    steps : (s, 2) pairs that follow each other on both lines, or on one at one place of the other
    step_mm : (s,) length of each
    """

    places: tuple[Places, Places]
    at: Array
    points_mm: Points
    radius_mm: Scalars
    misfit: Scalars
    steps: Array
    step_mm: Scalars

    def __len__(self) -> int:
        return len(self.points_mm)


def line_pairs(views: Sequence[VesselImage]) -> LinePairs | None:
    """Pair the lines of two views; None where there are none, or far too many.

    Parameters
    ----------
    views : two vessel images with their skeletons; what is likely a catheter is left out
    """
    carms = views[0].carm, views[1].carm
    found = [_places(view, carms) for view in views]
    if not all(0 < len(one) <= MOST_PLACES for one in found):
        return None
    first, second = found
    near = np.abs(first.plane_mm[:, None] - second.plane_mm[None]) < PLANE_MM
    if not 0 < np.count_nonzero(near) <= MOST_PAIRS:
        return None
    at = np.stack(np.nonzero(near))
    points, _ = triangulate(carms, [one.pixels[own] for one, own in zip(found, at, strict=True)])
    inside = np.linalg.norm(points, axis=1) < FARTHEST_MM
    at, points = at[:, inside], points[inside]
    width = np.stack(
        [
            np.maximum(one.width_mm[own] * _magnified(carm, points), LEAST_WIDTH_MM)
            for one, own, carm in zip(found, at, carms, strict=True)
        ]
    )
    steps = _steps(first, second, at)
    return LinePairs(
        places=(first, second),
        at=at,
        points_mm=points,
        radius_mm=0.5 * width.min(axis=0),
        misfit=np.abs(np.log(width[0] / width[1])),
        steps=steps,
        step_mm=np.linalg.norm(points[steps[:, 0]] - points[steps[:, 1]], axis=1),
    )


def _magnified(carm: CArm, points: Points) -> Scalars:
    """(n,) size of a pixel at (n, 3) points, beside that at the isocentre."""
    out: Scalars = np.linalg.norm(points - carm.source_mm, axis=1) / np.linalg.norm(carm.source_mm)
    return out


def _places(view: VesselImage, carms: tuple[CArm, CArm]) -> Places:
    pixel = view.carm.pixel_at_isocenter_mm
    number: dict[tuple[int, int], int] = {}
    steps: list[tuple[int, int]] = []
    lengths: list[float] = []
    line = view.skeleton
    if view.device is not None:
        line = line & (view.device <= MOST_DEVICE)
    for stretch in stretches_of(line):
        way = np.array(stretch, dtype=np.float64)
        arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(way, axis=0).T))) * pixel
        wanted = np.linspace(0.0, arc[-1], max(round(arc[-1] / STEP_MM), 1) + 1)
        places = np.unique(np.append(np.searchsorted(arc, wanted[:-1]), len(arc) - 1))
        ids = [number.setdefault(stretch[k], len(number)) for k in places.tolist()]
        steps += itertools.pairwise(ids)
        lengths += np.diff(arc[places]).tolist()
    count = len(number)
    pixels = np.array(list(number), dtype=np.float64).reshape(-1, 2)[:, ::-1]
    ends = np.array(steps, dtype=np.int64).reshape(-1, 2)
    inside = cv2.distanceTransform(view.mask.astype(np.uint8), cv2.DIST_L2, 5)
    col, row = pixels.astype(np.int64).T
    angle = plane_angles(*carms, view.carm, pixels) if count else np.zeros(0)
    graph = sparse.csr_matrix((lengths, (ends[:, 0], ends[:, 1])), shape=(count, count))
    tips = np.flatnonzero(np.bincount(ends.ravel(), minlength=count) < 2)
    tip_mm = np.full(count, np.inf)
    if len(tips):
        tip_mm = csgraph.dijkstra(graph, directed=False, indices=tips, min_only=True)
    each: Scalars = np.bincount(ends.ravel(), np.repeat(lengths, 2), minlength=count) / 2.0
    return Places(
        pixels=pixels,
        joined=_joined(ends, count),
        length_mm=each,
        width_mm=2 * pixel * inside[row, col].astype(np.float64),
        plane_mm=angle * reach_mm(*carms),
        tip_mm=tip_mm,
    )


def _joined(ends: Array, count: int) -> Array:
    """(n, k) each place with its neighbours, filled up with n."""
    both = np.concatenate([ends, ends[:, ::-1], np.repeat(np.arange(count)[:, None], 2, axis=1)])
    both = np.unique(both, axis=0)
    many = np.bincount(both[:, 0], minlength=count)
    out = np.full((count, int(many.max(initial=1))), count)
    first = np.cumsum(many) - many
    out[both[:, 0], np.arange(len(both)) - first[both[:, 0]]] = both[:, 1]
    return out


def _steps(first: Places, second: Places, at: Array) -> Array:
    """(s, 2) pairs whose places are neighbours, or the same, in both views; each once."""
    number = np.full((len(first) + 1, len(second) + 1), -1, dtype=np.int32)
    number[at[0], at[1]] = np.arange(at.shape[1])
    near = number[first.joined[at[0]][:, :, None], second.joined[at[1]][:, None, :]]
    near = near.reshape(at.shape[1], -1)
    own = np.repeat(np.arange(at.shape[1]), near.shape[1])
    steps = np.stack([own, near.ravel().astype(np.int64)], axis=1)
    return steps[steps[:, 1] > steps[:, 0]]
