"""Vessels that cross in a picture: which goes on as which.

Where two vessels cross in one view, either line beyond may belong to either vessel. Both choices
hang on the tree and fit both lines, so that nothing looks wrong; but what is wrongly paired seldom
has the right mass in both views. So the stretches beyond are exchanged on trial: in the view of
the crossing each takes the line of the other, followed from one epipolar plane to the next.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from gcar_deploy.config import TubeOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import plane_angles, reach_mm, triangulate
from gcar_deploy.tree.curves import resample
from gcar_deploy.tree.edit import NEW_STEP_MM, merged, reversed_branch
from gcar_deploy.tree.tree import Branch, Tree, along, polyline_arc
from gcar_deploy.tubes.gauss_newton import data_term
from gcar_deploy.tubes.model import Footprint
from gcar_deploy.tubes.targets import Target
from gcar_deploy.types import Array, Pixels, Points, Scalars

#: branches cross where they come so near in a view, mm at the isocentre, and lie so far apart, mm
CROSS_MM, APART_MM = 0.7, 2.0
#: stretches are followed in steps of this length, mm, and as long as their planes are so near, mm
STEP_MM, PLANE_MM = 0.75, 1.0
#: lines with more pairs of places so near than this, to each place, run along the planes
MOST_PAIRS = 20
#: shorter stretches are not exchanged, mm
LEAST_MM = 8.0
#: the new course is smoothed over so many steps
SMOOTH_STEPS = 2.0
#: the objective is summed so far from a stretch's line, mm
BESIDE_MM = 1.5


@dataclasses.dataclass(frozen=True)
class Stretch:
    """A branch from one of its points on.

    Attributes
    ----------
    branch : its number
    at : the point at which the stretch begins
    forward : whether it runs on to the branch's end, or back to its start
    """

    branch: int
    at: int
    forward: bool

    def line(self, tree: Tree) -> Points:
        """(n, 3) points along it."""
        points = tree.branches[self.branch].points_mm
        return points[self.at :] if self.forward else points[self.at :: -1]


@dataclasses.dataclass(frozen=True, eq=False)
class TrialExchange:
    """Two branches that may change partners beyond a crossing.

    Attributes
    ----------
    stretches : of both beyond the crossing
    courses_mm : (m, 3) where each would run instead, from the crossing
    """

    stretches: tuple[Stretch, Stretch]
    courses_mm: tuple[Points, Points]

    def applied(self, tree: Tree) -> Tree:
        """Return the tree with both exchanged; what hung on their far ends hangs on nothing."""
        nodes, branches = list(tree.nodes_mm), list(tree.branches)
        for own, course in zip(self.stretches, self.courses_mm, strict=True):
            branch = branches[own.branch]
            first = own.at
            if not own.forward:
                branch, first = reversed_branch(branch), len(branch) - 1 - first
            line = np.concatenate([branch.points_mm[: first + 1], course[1:]])
            branches[own.branch] = _redrawn(branch, resample(line, NEW_STEP_MM), len(nodes))
            nodes.append(branches[own.branch].points_mm[-1])
        return merged(Tree(nodes_mm=np.array(nodes), branches=tuple(branches)))


def trial_exchanges(tree: Tree, carms: Sequence[CArm]) -> list[TrialExchange]:
    """Find the stretches beyond crossings in either of two views that could be exchanged."""
    out = []
    for view, *places in _crossings(tree, carms):
        ways = [_ways(tree, carms, *place) for place in places]
        for one, other in itertools.product(*ways):
            pairs = followed(one.planes_mm, other.planes_mm)
            if pairs[-1].min() * STEP_MM < LEAST_MM:
                continue
            here, there = ([way.pixels[k][at] for k in (0, 1)]
                           for way, at in zip((one, other), pairs.T, strict=True))  # fmt: skip
            # In the view of the crossing each takes the other's line.
            here[view], there[view] = there[view], here[view]
            courses = _course(carms, here), _course(carms, there)
            out.append(TrialExchange((one.stretch, other.stretch), courses))
    return out


def followed(first: Scalars, second: Scalars) -> Array:
    """Follow two lines through the planes that they cross, as far as both do.

    Parameters
    ----------
    first, second : (n,), (m,) epipolar plane of each place, mm; both begin at the same

    Returns
    -------
    (k, 2) places of both that are paired, in order: each step moves on by one place along either or
    both, to planes at most ``PLANE_MM`` apart; the pairs' distances have the least sum. The first
    alone where both run along the planes, so that any place could be that of any other
    """
    gap = np.abs(first[:, None] - second[None])
    near = np.argwhere(gap <= PLANE_MM)
    if len(near) > MOST_PAIRS * (len(first) + len(second)):
        return np.zeros((1, 2), np.int64)
    # Cost so far, and the step back: all pairs that can be reached, a narrow band.
    best: dict[tuple[int, int], tuple[float, tuple[int, int]]] = {(0, 0): (gap[0, 0], (0, 0))}
    for i, j in near.tolist():
        before = [
            (best[back][0], back)
            for back in ((i - 1, j - 1), (i - 1, j), (i, j - 1))
            if back in best
        ]
        if before and (i or j):
            cost, back = min(before, key=lambda one: one[0])
            best[i, j] = (cost + gap[i, j], back)
    at = max(best, key=lambda pair: (sum(pair), -best[pair][0]))
    out = [at]
    while at != (0, 0):
        at = best[at][1]
        out.append(at)
    return np.array(out[::-1])


def costs(
    targets: Sequence[Target], prints: Sequence[Footprint], options: TubeOptions
) -> list[tuple[Array, Array]]:
    """Per view, (rows, cols) of the objective: of these tubes, and of a model without any."""
    out = []
    for target, seen in zip(targets, prints, strict=True):
        model = target.contrast * seen.image(target.path_mm.shape)
        scale = data_term(target, 1.0, options) * target.weight
        sigma = options.robust_sigmas * target.sigma_mm
        left, empty = (path / sigma for path in (target.path_mm - model, target.path_mm))
        out.append((scale * np.log1p(left * left), scale * np.log1p(empty * empty)))
    return out


def cost_beside(
    lines: Sequence[Points], targets: Sequence[Target], of: Sequence[tuple[Array, Array]]
) -> tuple[float, float]:
    """Sum both of ``costs`` beside (n, 3) lines, over all views."""
    total = np.zeros(2)
    for target, pictures in zip(targets, of, strict=True):
        near = np.zeros(target.path_mm.shape, np.uint8)
        wide = 2 * max(round(BESIDE_MM / target.pixel_mm), 1) + 1
        for line in lines:
            pixels = np.rint(target.carm.project(line)[0])
            # Drawing takes no more than 16 bits.
            cv2.polylines(near, [np.clip(pixels, -9999, 9999).astype(np.int32)], False, 1, wide)
        total += [picture[near > 0].sum() for picture in pictures]
    return float(total[0]), float(total[1])


def _crossings(
    tree: Tree, carms: Sequence[CArm]
) -> Iterator[tuple[int, tuple[int, int], tuple[int, int]]]:
    """View, and branch and point of two branches that cross there and lie apart."""
    points, number = tree.points(), tree.branch_index()
    start = np.searchsorted(number, np.arange(len(tree.branches)))
    for view, carm in enumerate(carms):
        pixels, _ = carm.project(points)
        pitch = np.array(carm.pixel_spacing_mm[::-1]) / carm.magnification
        near = cKDTree(pixels * pitch).query_pairs(CROSS_MM, output_type="ndarray")
        apart = np.linalg.norm(points[near[:, 0]] - points[near[:, 1]], axis=1) > APART_MM
        near = near[apart & (number[near[:, 0]] != number[near[:, 1]])]
        near = near[np.lexsort(near.T[::-1])]
        both = number[near]
        for one, other in np.unique(both, axis=0):
            own = near[(both == (one, other)).all(axis=1)]
            gap = np.linalg.norm((pixels[own[:, 0]] - pixels[own[:, 1]]) * pitch, axis=1)
            # One crossing of each run of neighbours.
            for run in np.split(np.arange(len(own)), np.flatnonzero(np.diff(own[:, 0]) > 3) + 1):
                a, b = own[run[gap[run].argmin()]]
                yield view, (int(one), int(a - start[one])), (int(other), int(b - start[other]))


@dataclasses.dataclass(frozen=True, eq=False)
class _Way:
    """A stretch, its (n, 2) pixels in both views in steps, and the (n,) planes of those, mm."""

    stretch: Stretch
    pixels: list[Pixels]
    planes_mm: Scalars


def _ways(tree: Tree, carms: Sequence[CArm], branch: int, at: int) -> list[_Way]:
    """Both ways along a branch, as far as they are long enough."""
    out = []
    for forward in (True, False):
        stretch = Stretch(branch, at, forward)
        line = stretch.line(tree)
        arc = polyline_arc(line)
        steps = along(line, arc, np.arange(0.0, arc[-1], STEP_MM))
        if len(steps) * STEP_MM >= LEAST_MM:
            pixels = [carm.project(steps)[0] for carm in carms]
            angle = plane_angles(carms[0], carms[1], carms[0], pixels[0])
            out.append(_Way(stretch, pixels, angle * reach_mm(carms[0], carms[1])))
    return out


def _course(carms: Sequence[CArm], pixels: Sequence[Pixels]) -> Points:
    """(k, 3) smooth line through the places that (k, 2) pixels of both views show."""
    points, _ = triangulate(carms, pixels)
    course: Points = gaussian_filter1d(points, SMOOTH_STEPS, axis=0, mode="nearest")
    return course


def _redrawn(branch: Branch, line: Points, end: int) -> Branch:
    """Return the branch along another line, each point with what is known of the nearest."""
    nearest = cKDTree(branch.points_mm).query(line)[1]
    return Branch(
        points_mm=line,
        radius_mm=branch.radius_mm[nearest],
        sigma_mm=np.full(len(line), np.nan),
        confidence=branch.confidence[nearest],
        start=branch.start,
        end=end,
    )
