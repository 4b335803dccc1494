"""Bundle adjustment on curves: where three or more views stand, told by the tree they show.

Mass profiles compare two views at a time along one direction. Once there is a tree, every point of
its centreline must lie on the centreline of every picture: with three and more views these are
more conditions than unknowns, and they tell the whole offset of a view, not its part along one
normal. Offsets, angles and points are found together by Gauss-Newton steps (Triggs et al.,
"Bundle adjustment - a modern synthesis", 2000, with the points eliminated, section 6.1); a point is
held to the nearest line of a picture along the line's normal alone, since nothing tells how far
along a vessel it is.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import ray_gaps
from gcar_deploy.geometry.prior import ANGLE_DEG, LANDMARK_MM, OFFSET_MM
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.pose.joint import corrected
from gcar_deploy.tree.tree import Tree, along
from gcar_deploy.types import Array, Points, Scalars

#: one standard deviation of a picture's centreline (neighbours err alike, so this is more than a
#: single point's error), and of a point's step, mm
LINE_MM, POINT_MM = 1.0, 2.0
#: a picture's line counts for a point within this reach, which shrinks to the second, mm
REACH_MM, NEAR_MM = 8.0, 2.0
STEPS = 25
#: points of the tree this far apart, mm, and how few say nothing
SPACING_MM, LEAST_POINTS = 2.0, 20
#: step of a correction for its derivative, degrees or mm
_TURN_DEG = 0.05


@dataclasses.dataclass(frozen=True, eq=False)
class Adjusted:
    """What the adjustment found.

    Attributes
    ----------
    theta : (V, 5) corrections of the views as they are told: x, y, z in mm, two angles in deg
    before_mm, after_mm : float
        Robust mean distance of the tree's points from the pictures' lines, the points free to
        suit all views as well as they can, with the corrections as given and as found.
    moving : float
        How far the last step still moved or turned a view, mm or deg.
    """

    theta: Array
    before_mm: float
    after_mm: float
    moving: float = 0.0


def adjust(
    tree: Tree, views: Sequence[VesselImage], told: Sequence[CArm], theta: Array,
    marks: Array | None = None,
) -> Adjusted:  # fmt: skip
    """Estimate the corrections of all views but the first from the tree that all show.

    Parameters
    ----------
    tree : Tree made with the corrections ``theta``
    views : V vessel images; of their C-arms nothing is used
    told : V C-arms without corrections, of the views' sizes
    theta : (V, 5) corrections that the tree was made with, the first of them zero
    marks : (m, V, 2) landmarks, (col, row), nan where not seen: rays of one point must meet
    """
    points = _sampled(tree, SPACING_MM)
    lines = [_Lines.of(view) for view in views]
    if len(points) < LEAST_POINTS or not all(line.any for line in lines):
        return Adjusted(theta, 0.0, 0.0)
    pixels = np.empty((0, len(told), 2)) if marks is None else marks
    kept, before, _ = _settled(points, lines, told, theta, pixels, poses=False)
    found, after, moving = _settled(points, lines, told, theta, pixels, poses=True)
    return (
        Adjusted(found, before, after, moving) if after < before else Adjusted(kept, before, before)
    )


@dataclasses.dataclass(frozen=True, eq=False)
class _Lines:
    """The centreline of a picture: distance to it and the nearest of its pixels, everywhere."""

    any: bool
    nearest: Array
    pixels: Array
    direction: Array
    pixel_mm: float

    @classmethod
    def of(cls, view: VesselImage) -> _Lines:
        seen = view.skeleton & view.valid
        rows, cols = np.nonzero(seen)
        if not len(rows):
            return cls(False, np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((0, 2)), 1.0)
        _, label = cv2.distanceTransformWithLabels(
            (~seen).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        number = np.zeros(int(label.max()) + 1, np.int64)
        number[label[rows, cols]] = np.arange(len(rows))
        smooth = cv2.GaussianBlur(seen.astype(np.float32), (0, 0), 2.0)
        gx, gy = (cv2.Sobel(smooth, cv2.CV_32F, *d, ksize=3) for d in ((1, 0), (0, 1)))
        xx, xy, yy = (cv2.GaussianBlur(a * b, (0, 0), 3.0) for a, b in
                      ((gx, gx), (gx, gy), (gy, gy)))  # fmt: skip
        # The gradient lies across the line.
        across = 0.5 * np.arctan2(2 * xy, xx - yy)[rows, cols]
        return cls(
            True, number[label], np.column_stack([cols, rows]).astype(np.float64),
            np.column_stack([-np.sin(across), np.cos(across)]), view.carm.pixel_at_isocenter_mm,
        )  # fmt: skip


def _sampled(tree: Tree, spacing_mm: float) -> Points:
    parts = []
    for branch in tree.branches:
        count = max(2, round(branch.length_mm / spacing_mm))
        at = np.linspace(0, branch.length_mm, count + 1)
        parts.append(along(branch.points_mm, branch.arc_mm, at))
    return np.concatenate(parts) if parts else np.zeros((0, 3))


def _settled(
    points: Points, lines: Sequence[_Lines], told: Sequence[CArm], theta: Array, marks: Array,
    *, poses: bool,
) -> tuple[Array, float, float]:  # fmt: skip
    """Corrections, mean distance and last move after the steps; ``poses`` False: points alone."""
    theta, points = theta.copy(), points.copy()
    reach = REACH_MM
    for _ in range(STEPS):
        parts = _linearised(points, lines, told, theta, reach)
        move, turn = _step(*parts, theta, _marked(told, theta, marks))
        points = points + move
        if poses:
            theta[1:] += turn
        reach = max(NEAR_MM, 0.8 * reach)
    gap = _linearised(points, lines, told, theta, reach)[0]
    distance = float(np.minimum(np.abs(gap), reach).mean())
    return theta, distance, float(np.abs(turn).max(initial=0.0)) if poses else 0.0


def _linearised(
    points: Points, lines: Sequence[_Lines], told: Sequence[CArm], theta: Array, reach_mm: float
) -> tuple[Scalars, Scalars, Array, Array]:
    """Gap of every point in every view, mm, and what it changes with.

    Returns
    -------
    gap, weight : (V, n), mm at the isocentre; the weight falls to 0 at ``reach_mm``
    by_point : (V, n, 3) change of the gap with the point, mm per mm
    by_pose : (V, n, 5) change with the view's correction
    """
    n = len(points)
    gap, weight = np.full((len(told), n), reach_mm), np.zeros((len(told), n))
    by_point, by_pose = np.zeros((len(told), n, 3)), np.zeros((len(told), n, 5))
    for k, (line, carm) in enumerate(zip(lines, told, strict=True)):
        now = corrected(carm, theta[k])
        pixels, depth = now.project(points)
        at = np.rint(np.nan_to_num(pixels, nan=-1.0)).clip(-1, 1e6).astype(np.int64)
        inside = (depth > 1) & (at >= 0).all(axis=1)
        inside &= (at[:, 0] < line.nearest.shape[1]) & (at[:, 1] < line.nearest.shape[0])
        at[~inside] = 0
        near = line.nearest[at[:, 1], at[:, 0]]
        normal = line.direction[near] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
        away = pixels - line.pixels[near]
        distance = np.hypot(*away.T) * line.pixel_mm
        gap[k] = np.where(inside, np.einsum("ij,ij->i", away, normal) * line.pixel_mm, reach_mm)
        # Tukey's biweight: what has no line near it says nothing.
        weight[k] = np.where(inside, np.clip(1 - (distance / reach_mm) ** 2, 0, None) ** 2, 0.0)
        by_point[k] = np.einsum("ni,nij->nj", normal, now.jacobian(points)) * line.pixel_mm
        by_pose[k, :, :3] = by_point[k]
        for turn in (3, 4):
            turned = theta[k].copy()
            turned[turn] += _TURN_DEG
            step = (corrected(carm, turned).project(points)[0] - pixels) / _TURN_DEG
            by_pose[k, :, turn] = np.einsum("ij,ij->i", step, normal) * line.pixel_mm
    return gap, weight, by_point, by_pose


def _prior(theta: Array) -> Array:
    """(V - 1, 5) inverse variances of the corrections.

    A patient breathes by millimetres or the table moves by centimetres, so the offset has heavy
    tails: Cauchy's density of its length, as the Gaussian with the same pull where it stands.
    """
    length2 = np.sum(theta[1:, :3] ** 2, axis=1, keepdims=True)
    offset = 2.0 / (OFFSET_MM**2 + length2)
    turn = np.full_like(offset, ANGLE_DEG**-2)
    return np.hstack([offset] * 3 + [turn] * 2)


def _marked(told: Sequence[CArm], theta: Array, marks: Array) -> tuple[Scalars, Array]:
    """(r,) gaps between the rays of landmarks and (r, V - 1, 5) their change, standardised."""
    pairs = list(itertools.combinations(range(len(told)), 2))
    seen = [np.isfinite(marks[:, pair]).all(axis=(1, 2)) for pair in pairs]

    def gaps(at: Array) -> Scalars:
        now = [corrected(carm, t) for carm, t in zip(told, at, strict=True)]
        parts = [
            ray_gaps(now[i], now[j], marks[ok, i], marks[ok, j])
            for (i, j), ok in zip(pairs, seen, strict=True)
        ]
        return np.concatenate(parts) / LANDMARK_MM

    here = gaps(theta)
    change = np.zeros((len(here), len(theta) - 1, 5))
    for k, part in np.ndindex(change.shape[1:]) if len(here) else ():
        moved = theta.copy()
        moved[k + 1, part] += _TURN_DEG
        change[:, k, part] = (gaps(moved) - here) / _TURN_DEG
    return here, change


def _step(
    gap: Scalars, weight: Scalars, by_point: Array, by_pose: Array, theta: Array,
    marked: tuple[Scalars, Array],
) -> tuple[Points, Array]:  # fmt: skip
    """Gauss-Newton step of (n, 3) points and (V - 1, 5) corrections, the points eliminated."""
    count, prior = len(theta) - 1, _prior(theta)
    w = weight / LINE_MM**2
    H = np.einsum("kn,kni,knj->nij", w, by_point, by_point) + np.eye(3) / POINT_MM**2
    g = np.einsum("kn,kni,kn->ni", w, by_point, gap)
    inverse = np.linalg.inv(H)
    # B[n, k]: coupling of point n with view k, (3, 5)
    B = np.einsum("kn,kni,knj->nkij", w, by_point, by_pose)[:, 1:]
    A = np.einsum("kn,kni,knj->kij", w, by_pose, by_pose)[1:]
    b = np.einsum("kn,kni,kn->ki", w, by_pose, gap)[1:] + theta[1:] * prior
    whole = -np.einsum("nkia,nij,nljb->kalb", B, inverse, B)
    for k in range(count):
        whole[k, :, k] += A[k] + np.diag(prior[k])
    whole += np.einsum("rka,rlb->kalb", marked[1], marked[1])
    right = b - np.einsum("nkia,nij,nj->ka", B, inverse, g)
    right += np.einsum("r,rka->ka", marked[0], marked[1])
    turn = -np.linalg.solve(whole.reshape(5 * count, -1), right.ravel()).reshape(count, 5)
    moved = g + np.einsum("nkia,ka->ni", B, turn)
    return -np.einsum("nij,nj->ni", inverse, moved), turn
