"""Frontier points: where vessels of two pictures touch the same epipolar planes.

Where a vessel turns back across the epipolar planes, or ends, the plane that touches its outline
is the same in both pictures (frontier points: Cipolla and Giblin, Visual Motion of Curves and
Surfaces, 2000, chapter 6), whatever overlaps elsewhere and however much contrast a pixel has. So
they tell of masks and raw pictures what mass profiles tell of exact ones: the pose, and a smooth
motion of the heart across the planes.

Which point of one picture is which of the other is not known. Each has a partner of its side and
about its mass where pose and motion put it, or none (clutter). Partners and motion are found in
turn, by expectation and maximisation, with a match that narrows from millimetres to a pixel.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import plane_normal, plane_slices, reach_mm
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.pose.joint import corrected
from gcar_deploy.pose.motion import DIGITS, Modes, Motion, pixel_size_mm, thinned
from gcar_deploy.pose.pairwise import Pose
from gcar_deploy.pose.profile_fit import FREE, pair_theta
from gcar_deploy.types import Array, Pixels, Scalars

#: an extremum stands out by so much from what it hangs together with, within so far; shorter parts
#: of a mask have none, nor has what lies this near to the border
STANDS_OUT_MM, WITHIN_MM, LEAST_PART_MM, BORDER_PX = 0.8, 12.0, 6.0, 4
#: vessel so far below an extremum is its mass. Logarithms of it differ by ``ALIKE`` between
#: partners, by ``ANY`` between any two points, and between partners of which one is overlapped
CAP_MM, ALIKE, ANY, OVERLAPPED = 3.0, 0.35, 1.3, 0.2
#: width of the match from the first fit to the last, mm; steps with each; points without a partner
#: for every mm across the planes
WIDTHS_MM, STEPS, CLUTTER = (2.0, 1.4, 1.0, 0.7, 0.5, 0.35, 0.25), 3, 0.03
#: priors of what is left of a pose, one standard deviation; shifts that are tried first, mm
SHIFT_MM, TURN_DEG, STARTS_MM = 2.0, 0.3, np.arange(-4.0, 4.1, 1.0)
#: prior of a mode of the motion: a few points say less than whole profiles, for which it is 1
MODE = 0.75
#: pixels coarser than so many mm blur what stands out and how well it matches
FINE_MM = 0.4
#: masks show motion where its estimate is larger than this, mm, or where fewer of the points match
#: those of a rigid heart; raw pictures, whose vessels end where their contrast does, by the
#: estimate alone. A heart that moved must be so much likelier than one at rest in the pose as
#: given. Chosen on 60 generated pairs of masks at rest and 45 of raw pictures, and as many moved
MASK_MM, LEAST_MATCHED, MASK_GAIN = 0.3, 0.6, 3.0
RAW_MM, RAW_GAIN = 0.55, 8.0
#: fewer points than this tell nothing. What masks tell is undone where so many points, and such a
#: share of them, match then, and it is so much likelier; a rigid correction the same
LEAST_POINTS, UNDONE, PLACED = 3, (7, 0.8, 5.0), (3, 0.7, 3.0)
#: vessel pixels that the size of a motion is taken over
VESSEL_PIXELS = 1000
#: steps of a pose's unknowns for derivatives (mm, deg, deg)
_STEP = np.array([0.1, 0.02, 0.02])


@dataclasses.dataclass(frozen=True, eq=False)
class Frontier:
    """Extrema of one picture's vessels across the epipolar planes.

    Attributes
    ----------
    pixels : (n, 2) (col, row)
    side : (n,) 1 where a plane a little further on touches nothing there, -1 where one before
    mass : (n,) logarithm of the vessel mass next to each, any scale
    """

    pixels: Pixels
    side: Array
    mass: Scalars


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Agreement:
    """What the frontier points of two views say of their pose, and of motion between them.

    Attributes
    ----------
    count : int, points of the view that has fewer
    theta : (5,) correction of the moving view that suits most points of a rigid heart
    gain : log likelihood that it wins over the pose as given
    matched : float, share of ``count`` that then has a partner
    moving_theta, motion : the same where the heart may have moved
    moving_gain, moving_matched : what that wins over the rigid heart, and the share with a partner
    """

    count: int
    theta: Array
    gain: float
    matched: float
    moving_theta: Array
    motion: Motion
    moving_gain: float
    moving_matched: float


def frontier_points(view: VesselImage, pair: tuple[CArm, CArm]) -> Frontier:
    """Find the frontier points of one view.

    Parameters
    ----------
    view : VesselImage, one of the pair
    pair : CArms of both views
    """
    rows, cols = np.nonzero(view.mask)
    if not len(rows):
        return Frontier(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    pixels = np.column_stack([cols, rows]).astype(np.float64)
    angle, weight = plane_slices(*pair, view.carm, pixels)
    corner = np.array([rows.min(), cols.min()])
    rows, cols = rows - corner[0], cols - corner[1]
    shape = (rows.max() + 1, cols.max() + 1)
    mass = np.zeros(shape)
    mass[rows, cols] = view.path_mm[view.mask] * weight / weight.max()
    mask = view.mask[corner[0] : corner[0] + shape[0], corner[1] : corner[1] + shape[1]]
    pixel = view.carm.pixel_at_isocenter_mm
    inside = _long_parts(mask, pixel)
    found = []
    for side in (1.0, -1.0):
        across = np.full(shape, -1e3)
        across[rows, cols] = side * reach_mm(*pair) * angle
        top = cv2.dilate(across, np.ones((5, 5), np.uint8))
        kept: list[tuple[int, int]] = []
        for row, col in np.argwhere(inside & (across == top)).tolist():
            at = np.array([row, col]) + corner
            if (at < BORDER_PX).any() or (at >= np.array(view.mask.shape) - BORDER_PX).any():
                continue
            if any((row - i) ** 2 + (col - j) ** 2 <= 9 for i, j in kept):
                continue  # a flat top is one point
            cap = _cap_mass(across, mass, (row, col), pixel)
            if cap is not None:
                kept.append((row, col))
                found.append((float(at[1]), float(at[0]), side, cap))
    out = np.array(found).reshape(-1, 4)
    return Frontier(out[:, :2], out[:, 2], out[:, 3])


def coarser(pixel_mm: float) -> float:
    """Return how many times coarser than ``FINE_MM`` pixels are, at least 1."""
    return max(1.0, pixel_mm / FINE_MM)


def _long_parts(mask: Array, pixel_mm: float) -> Array:
    _, label, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    sizes = np.hypot(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]) * pixel_mm
    sizes[0] = 0.0
    out: Array = (sizes >= LEAST_PART_MM)[label]
    return out


def _cap_mass(across: Array, mass: Array, at: tuple[int, int], pixel_mm: float) -> float | None:
    """Logarithm of the mass below an extremum; None where the point is none."""
    reach = int(WITHIN_MM / pixel_mm) + 2
    low = np.maximum(np.array(at) - reach, 0)
    window = slice(low[0], at[0] + reach), slice(low[1], at[1] + reach)
    height, here = across[window], tuple(np.array(at) - low)
    top = height[here]

    def hangs_together(depth_mm: float) -> Array:
        _, label = cv2.connectedComponents((height > top - depth_mm).astype(np.uint8))
        return np.asarray(label == label[here])

    if height[hangs_together(coarser(pixel_mm) * STANDS_OUT_MM)].max() > top:
        return None
    return float(np.log(max(mass[window][hangs_together(CAP_MM)].sum(), 1e-9)))


def agree_at_frontiers(fixed: VesselImage, moving: VesselImage, theta: Array) -> Agreement | None:
    """Compare two views at their frontier points.

    Parameters
    ----------
    fixed : VesselImage with its pose built in
    moving : VesselImage as it is told
    theta : (5,) correction of it as estimated so far

    Returns
    -------
    Agreement; None where a view has no such point
    """
    carm = corrected(moving.carm, theta)
    pair = fixed.carm, carm
    points = tuple(
        frontier_points(view, pair) for view in (fixed, dataclasses.replace(moving, carm=carm))
    )
    if not all(len(p.pixels) for p in points):
        return None
    match = _Match.of(
        points[0], points[1], pair, np.argwhere(moving.mask)[:, ::-1].astype(np.float64)
    )
    rest = match.evidence(np.zeros(FREE + match.field.count))[0]
    rigid, moved = match.best(FREE), match.best(FREE + match.field.count)
    motion_mm = match.field.at(carm, match.vessel) @ moved[0][FREE:]
    count = min(len(p.pixels) for p in points)
    return Agreement(
        count=count,
        theta=theta + pair_theta(rigid[0], match.normal), gain=rigid[1] - rest,
        matched=float(rigid[2].sum()) / count,
        moving_theta=theta + pair_theta(moved[0], match.normal),
        motion=match.field.motion(moved[0][FREE:], float(motion_mm.std())),
        moving_gain=moved[1] - rigid[1], moving_matched=float(moved[2].sum()) / count,
    )  # fmt: skip


def by_frontiers(views: Sequence[VesselImage], pose: Pose, marked: bool) -> Pose:
    """Return the pose of the second of two views by what their frontier points say.

    Parameters
    ----------
    views : two vessel images, not both exact
    pose : of the second, by mass profiles
    marked : whether a person said which points are the same; then only motion is told
    """
    told = agree_at_frontiers(views[0], views[1], pose.theta)
    if told is None or told.count < LEAST_POINTS:
        return pose
    coarse = coarser(max(view.carm.pixel_at_isocenter_mm for view in views))
    seen_mm, gain = told.motion.rms_mm, told.gain + told.moving_gain
    if not all(view.calibrated or view.kind == "mask" for view in views):
        moved = seen_mm > RAW_MM * coarse and gain > RAW_GAIN
        return dataclasses.replace(pose, left_mm=seen_mm) if moved else pose
    found, limit_mm = (told.count, told.matched, told.gain), MASK_MM * coarse
    clear = seen_mm <= limit_mm and told.matched >= LEAST_MATCHED
    if clear or gain <= MASK_GAIN:
        return pose if marked or not clear or not _reaches(found, PLACED) else pose.at(told.theta)
    if not marked and _reaches((told.count, told.moving_matched, told.moving_gain), UNDONE):
        return dataclasses.replace(pose.at(told.moving_theta), motion=told.motion)
    return dataclasses.replace(pose, left_mm=max(seen_mm, limit_mm))


def _reaches(found: tuple[float, ...], least: tuple[float, ...]) -> bool:
    return all(a >= b for a, b in zip(found, least, strict=True))


@dataclasses.dataclass(frozen=True, eq=False)
class _Match:
    """Frontier points of both views, and how the gap of each two depends on the unknowns.

    Attributes
    ----------
    gap_mm : (n, m) across the planes, of each point of the first view and each of the second
    slope : (n, m, k) its change with the unknowns: shift, two angles, modes of the motion
    likely : (n, m) how much likelier the masses of the two are of one point than of any two
    field, normal, vessel : modes; (3,) across the planes; (v, 2) vessel pixels of the second view
    width_mm : how well partners match, one standard deviation
    """

    gap_mm: Array
    slope: Array
    likely: Array
    field: Modes
    normal: Array
    vessel: Pixels
    width_mm: float

    @classmethod
    def of(
        cls, first: Frontier, second: Frontier, pair: tuple[CArm, CArm], vessel: Pixels
    ) -> _Match:
        fixed, carm = pair
        normal = plane_normal(fixed, carm)
        field = Modes.of(fixed, carm, vessel)

        def gaps(told: CArm, moved: Pixels) -> Array:
            both = fixed, told
            a = reach_mm(*pair) * plane_slices(*both, fixed, first.pixels)[0]
            b = reach_mm(*pair) * plane_slices(*both, told, moved)[0]
            return a[:, None] - b[None]

        here = gaps(carm, second.pixels)
        pose = [
            (gaps(corrected(carm, pair_theta(step, normal)), second.pixels) - here) / size
            for step, size in zip(np.diag(_STEP), _STEP, strict=True)
        ]
        step_mm = 0.1
        moved = second.pixels + step_mm * field.direction / pixel_size_mm(carm)
        by_mm = (gaps(carm, moved) - here) / step_mm
        modes = by_mm[:, :, None] * field.at(carm, second.pixels)[None]
        apart = first.mass[:, None] - second.mass[None]
        apart -= np.median(first.mass) - np.median(second.mass)
        one = (1 - OVERLAPPED) * _bell(apart, ALIKE) + OVERLAPPED * _bell(apart, ANY)
        same = first.side[:, None] == second.side[None]
        return cls(
            here, np.concatenate([np.stack(pose, axis=2), modes], axis=2),
            same * one / (_bell(apart, ANY) + 1e-3), field, normal,
            thinned(vessel, VESSEL_PIXELS),
            WIDTHS_MM[-1] * coarser(max(view.pixel_at_isocenter_mm for view in pair)),
        )  # fmt: skip

    @property
    def prior(self) -> Scalars:
        """(k,) standard deviations of the unknowns."""
        return np.concatenate([[SHIFT_MM, TURN_DEG, TURN_DEG], np.full(self.field.count, MODE)])

    def evidence(self, x: Scalars, width_mm: float = 0.0) -> tuple[float, Array, Array]:
        """Log posterior of (k,) unknowns, (n, m) probability of each partnership, (n, m) gaps."""
        gap = self.gap_mm + self.slope @ x
        density = self.likely * _bell(gap, max(width_mm, self.width_mm)) / np.sqrt(2 * np.pi)
        of_first, of_second = density.sum(axis=1), density.sum(axis=0)
        each = density / (CLUTTER + of_first)[:, None], density / (CLUTTER + of_second)[None]
        told = np.log1p(of_first / CLUTTER).sum() + np.log1p(of_second / CLUTTER).sum()
        value = 0.5 * float(told) - 0.5 * float(np.sum((x / self.prior) ** 2))
        return value, np.sqrt(each[0] * each[1]), gap

    def best(self, free: int) -> tuple[Scalars, float, Array]:
        """Return the best of the first ``free`` unknowns from all starts; evidence, partners."""
        starts = np.zeros((len(STARTS_MM), len(self.prior)))
        starts[:, 0] = STARTS_MM
        found = [self._settled(x, free) for x in starts]
        return max(found, key=lambda one: one[1])

    def _settled(self, x: Scalars, free: int) -> tuple[Scalars, float, Array]:
        x = x.copy()
        slope, rest = self.slope[:, :, :free], np.diag(self.prior[:free] ** -2.0)
        for width in WIDTHS_MM:
            for _ in range(STEPS):
                _, partner, gap = self.evidence(x, width)
                w = partner / max(width, self.width_mm) ** 2
                some = w > 1e-9
                J = slope[some]
                weighted = J.T * w[some]
                pull = weighted @ gap[some] + rest @ x[:free]
                x[:free] -= np.linalg.solve(weighted @ J + rest, pull)
        x = np.round(x, DIGITS)
        value, partner, _ = self.evidence(x)
        return x, value, partner


def _bell(x: Array, width: float) -> Array:
    out: Array = np.exp(-0.5 * (x / width) ** 2) / width
    return out
