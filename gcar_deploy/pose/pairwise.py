"""Pose between two views from epipolar consistency alone, before there is any tree.

Every plane through both sources cuts the same slice of vessel out of both pictures, so the
vessel mass per plane must agree. A patient who moved between the runs, or an angle that was
read off wrongly, makes the profiles differ; the correction that makes them agree again is what
the pictures can tell. What they cannot tell is held at zero by its prior: in raw pictures all
motion within the planes, in calibrated ones, whose cone-beam profiles agree to a part in a
thousand, no more than the direction of the line through both sources.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gcar_deploy.config import PoseOptions, QualityOptions
from gcar_deploy.geometry.carm import CArm, separation_deg
from gcar_deploy.geometry.consistency import (
    Mass,
    disagreement,
    mass_profiles,
    mismatch,
    sampling_noise,
    uncovered_mm,
    vessel_mass,
)
from gcar_deploy.geometry.epipolar import plane_normal, ray_gaps
from gcar_deploy.geometry.prior import LANDMARK_MM
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.pose.joint import corrected, estimate_jointly
from gcar_deploy.pose.motion import Motion
from gcar_deploy.pose.profile_fit import (
    CALIBRATED_NOISE,
    MIN_GAIN,
    MOST_APART_DEG,
    SEARCH_MM,
    STEP_MM,
    covers,
    fit_profiles,
    prior_root,
    prior_sigmas,
    tolerances,
)
from gcar_deploy.types import Array, Image, Pixels

#: corrections from these on are said in words: more than a breath between two runs leaves, or
#: than a gantry's display is off
SAID_SHIFT_MM, SAID_TURN_DEG = 2.0, 1.0
#: calibrated pictures that differ as they are told by no more times what their pixels alone make of
#: it are left alone
AGREED_GRAIN = 2.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pose:
    """Correction of one view relative to the first.

    Attributes
    ----------
    offset_mm : (3,) the patient moved by so much before this view, mm LPS
    primary_deg, secondary_deg : float, correction of the angles
    before, after : float
        Disagreement of the two mass profiles, 0 (equal) .. 1 (nothing in common).
    partner : int
        View that this one was compared with; itself where there was none to compare with.
    landmark_before_mm, landmark_after_mm : float or None
        Root mean square distance between the rays of the landmarks that both views show.
    converged : bool
        False where the correction is that of a fit that was stopped at its cap.
    motion : Motion or None
        Smooth motion of the heart beyond a shift, which is undone in this view's picture.
    left_mm : float
        Root mean square of such a motion that was seen and could not be undone.
    """

    offset_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    primary_deg: float = 0.0
    secondary_deg: float = 0.0
    before: float = 0.0
    after: float = 0.0
    partner: int = 0
    landmark_before_mm: float | None = None
    landmark_after_mm: float | None = None
    converged: bool = True
    motion: Motion | None = None
    left_mm: float = 0.0

    @property
    def motion_mm(self) -> float:
        """Root mean square of the motion beyond a shift, as far as two views see it."""
        return self.left_mm if self.motion is None else self.motion.rms_mm

    @property
    def shift_mm(self) -> float:
        """Length of the offset."""
        return float(np.linalg.norm(self.offset_mm))

    @property
    def turn_deg(self) -> float:
        """The larger of the two angle corrections."""
        return max(abs(self.primary_deg), abs(self.secondary_deg))

    def note(self, view: str, count: int, options: QualityOptions) -> str | None:
        """Return a large correction in words, for the view of that name; None of a small one.

        Of ``count`` views two leave part of a move unseen. Above the gates a finding says so.
        """
        if self.shift_mm < SAID_SHIFT_MM and self.turn_deg < SAID_TURN_DEG:
            return None
        found = self.shift_mm > options.good_shift_mm or self.turn_deg > options.good_turn_deg
        unseen = "" if found or count > 2 else (
            "; a move within the plane of both beams may not show: the whole tree may lie off by it"
        )  # fmt: skip
        return (
            f"view {view} was taken for moved by {self.shift_mm:.1f} mm and turned by "
            f"{self.turn_deg:.1f} deg, so that it agrees with the others (--pose off: as told)"
            f"{unseen}"
        )

    def at(self, theta: Array) -> Pose:
        """Return the pose with another (5,) correction."""
        x, y, z, primary, secondary = (float(value) for value in theta)
        return dataclasses.replace(
            self, offset_mm=(x, y, z), primary_deg=primary, secondary_deg=secondary
        )

    def seen_turned(self, turns: int) -> Pose:
        """Return the pose of the picture turned anticlockwise by so many quarter turns."""
        if self.motion is None or not turns:
            return self
        return dataclasses.replace(self, motion=self.motion.turned(turns))

    def applied(self, carm: CArm) -> CArm:
        """Return the view with the correction built in."""
        return corrected(carm, self.theta)

    def still(self, angiogram: Angiogram) -> Angiogram:
        """Return a picture with the motion undone."""
        return angiogram if self.motion is None else self.motion.undone_picture(angiogram)

    def still_at(self, carm: CArm, point: tuple[float, float]) -> tuple[float, float]:
        """Return where a point (col, row) of the picture stands with the motion undone."""
        if self.motion is None:
            return point
        (moved,) = np.array([point]) + self.motion.at(carm, np.array([point]))
        column, row = np.clip(moved, 0.0, [carm.columns - 1.0, carm.rows - 1.0]).tolist()
        return column, row

    @property
    def theta(self) -> Array:
        """(5,) offset x, y, z in mm, primary and secondary angle in degrees."""
        return np.array([*self.offset_mm, self.primary_deg, self.secondary_deg])


def worst_of(poses: Sequence[Pose]) -> float:
    """Worst disagreement of any view with its partner after the corrections, 0 .. 1."""
    return max(pose.after for pose in poses)


def estimate_poses(
    views: Sequence[tuple[CArm, Image]],
    options: PoseOptions,
    landmarks: Array | None = None,
    calibrated: Sequence[bool] | None = None,
    masks: Sequence[bool] | None = None,
    grains: Sequence[Image | None] | None = None,
) -> tuple[Pose, ...]:
    """Estimate the correction of every view against the first, directly or through others.

    Each view is compared with that of those already placed whose direction is nearest to 90 deg
    from its own. Nearly opposite views cannot be compared: the line through both sources runs
    through the picture, and planes about it cut no slices. Three and more views are then fitted
    together (``joint``), which sees what each pair alone cannot.

    Parameters
    ----------
    views : sequence of (CArm, path_mm)
        Path lengths in any scale, zero outside vessels; some 128^2 pixels are enough.
    options : PoseOptions
        ``fine_mm`` at least the pixel at the isocentre, or calibrated profiles differ by pixels.
    landmarks : (m, V, 2) (col, row) of points marked in the views as they are here, nan where
        not seen; the rays of one point must meet
    calibrated : per view, whether the path lengths are in mm; none where left out
    masks : per view, whether they are told by the width of a mask; none where left out
    grains : per view (rows, cols), see ``Mass``, or None

    Returns
    -------
    tuple of Pose, the first of them zero
    """
    marks = np.empty((0, len(views), 2)) if landmarks is None else landmarks
    exact = [False] * len(views) if calibrated is None else calibrated
    wide = [False] * len(views) if masks is None else masks
    fine = [None] * len(views) if grains is None else grains
    masses = [
        vessel_mass(*view, known, mask, grain)
        for view, known, mask, grain in zip(views, exact, wide, fine, strict=True)
    ]
    poses = {0: Pose()}
    while len(poses) < len(views):
        left = [k for k in range(len(views)) if k not in poses]
        _, k, partner = min(
            (abs(separation_deg(views[j][0], views[k][0]) - 90.0), k, j)
            for k in left
            for j in poses
        )
        placed = masses[partner]
        apart = separation_deg(views[partner][0], views[k][0])
        if placed is None or apart > MOST_APART_DEG:
            poses[k] = Pose(partner=k)
            continue
        fixed = dataclasses.replace(placed, carm=poses[partner].applied(placed.carm))
        both = marks[np.isfinite(marks[:, [partner, k]]).all(axis=(1, 2))]
        pose = _estimate(fixed, masses[k], options, (both[:, partner], both[:, k]))
        poses[k] = dataclasses.replace(pose, partner=partner)
    found = tuple(poses[k] for k in range(len(views)))
    if len(views) < 3 or not options.enabled:
        return found
    theta, converged = estimate_jointly(masses, np.stack([p.theta for p in found]), options, marks)
    if all(np.array_equal(t, p.theta) for t, p in zip(theta, found, strict=True)):
        return found
    return tuple(
        dataclasses.replace(
            _joint(k, theta, found[k].partner, masses, options, marks), converged=converged
        )
        for k in range(len(views))
    )


def judged_poses(
    poses: Sequence[Pose], views: Sequence[tuple[CArm, Image]], options: PoseOptions,
    marks: Array, calibrated: Sequence[bool],
) -> tuple[Pose, ...]:  # fmt: skip
    """Return the same corrections with what profiles and landmarks say of them.

    Parameters
    ----------
    poses : V corrections with their partners
    views, options, calibrated : as for ``estimate_poses``
    marks : (m, V, 2) landmarks, (col, row), nan where not seen
    """
    masses = [vessel_mass(*view, known) for view, known in zip(views, calibrated, strict=True)]
    theta = np.stack([pose.theta for pose in poses])
    return tuple(
        dataclasses.replace(
            _joint(k, theta, pose.partner, masses, options, marks), converged=pose.converged
        )
        for k, pose in enumerate(poses)
    )


def _joint(
    k: int, theta: Array, partner: int, masses: Sequence[Mass | None], options: PoseOptions,
    marks: Array,
) -> Pose:  # fmt: skip
    """Correction ``theta[k]`` with the agreement with the view's partner before and after."""
    fixed, moving = masses[partner], masses[k]
    x, y, z, primary, secondary = (float(value) for value in theta[k])
    pose = Pose(offset_mm=(x, y, z), primary_deg=primary, secondary_deg=secondary, partner=partner)
    if partner == k or fixed is None or moving is None:
        return pose
    both = marks[np.isfinite(marks[:, [partner, k]]).all(axis=(1, 2))]
    pixels = both[:, partner], both[:, k]
    placed = dataclasses.replace(fixed, carm=corrected(fixed.carm, theta[partner]))
    carm = corrected(moving.carm, theta[k])
    return dataclasses.replace(
        pose,
        before=disagreement(fixed, moving, moving.carm, options.fine_mm),
        after=disagreement(placed, moving, carm, options.fine_mm),
        landmark_before_mm=_gap_mm(fixed.carm, moving.carm, pixels),
        landmark_after_mm=_gap_mm(placed.carm, carm, pixels),
    )


def _estimate(
    fixed: Mass | None, moving: Mass | None, options: PoseOptions, marks: tuple[Pixels, Pixels]
) -> Pose:
    if fixed is None or moving is None:
        return Pose()
    before = disagreement(fixed, moving, moving.carm, options.fine_mm)
    gap = _gap_mm(fixed.carm, moving.carm, marks)
    given = Pose(before=before, after=before, landmark_before_mm=gap, landmark_after_mm=gap)
    calibrated = fixed.calibrated and moving.calibrated
    apart = mismatch(fixed, moving, moving.carm, options.fine_mm)
    grain = sampling_noise(fixed, moving, moving.carm, options.fine_mm)
    agreed = calibrated and gap is None and apart <= max(CALIBRATED_NOISE, AGREED_GRAIN * grain)
    if agreed or not options.enabled:
        return given
    prior = prior_sigmas()
    root = prior_root(moving.carm)

    def residuals(theta: Array, sigma_mm: float, noise: float) -> Array:
        carm = corrected(moving.carm, theta)
        a, b = mass_profiles(fixed, moving, carm, sigma_mm)
        gaps = ray_gaps(fixed.carm, carm, *marks) / LANDMARK_MM
        return np.concatenate([(a - b) / (noise * np.sqrt(float(a @ a))), root @ theta, gaps])

    def left(theta: Array, sigma_mm: float) -> float:
        return mismatch(fixed, moving, corrected(moving.carm, theta), sigma_mm)

    normal = plane_normal(fixed.carm, moving.carm)
    start, best = np.zeros(5), np.inf
    noise, most_left = tolerances((fixed, moving))
    near = calibrated and apart <= noise
    reach = 0.0 if near else SEARCH_MM
    for shift in np.arange(-reach, reach + 1e-9, STEP_MM):
        theta = np.concatenate([shift * normal, np.zeros(2)])
        r = residuals(theta, options.coarse_mm, noise)
        if float(r @ r) < best:
            start, best = theta, float(r @ r)
    start, converged = fit_profiles(
        residuals, left, start, prior, options, calibrated=calibrated, noise=noise
    )
    carm = corrected(moving.carm, start)
    after, gap_after = (
        disagreement(fixed, moving, carm, options.fine_mm),
        _gap_mm(fixed.carm, carm, marks),
    )
    marked = gap is not None and gap_after is not None
    better = marked and (gap_after or 0.0) < MIN_GAIN * (gap or 0.0)
    if not better and (
        after > most_left * before
        or not covers(fixed, moving, carm, uncovered_mm(fixed, moving, moving.carm))
    ):
        # Not clearly better than the geometry as given: leave it alone.
        return given
    x, y, z, primary, secondary = (float(value) for value in start)
    return Pose(
        offset_mm=(x, y, z),
        primary_deg=primary,
        secondary_deg=secondary,
        before=before,
        after=after,
        landmark_before_mm=gap,
        landmark_after_mm=gap_after,
        converged=converged,
    )


def _gap_mm(first: CArm, second: CArm, marks: tuple[Pixels, Pixels]) -> float | None:
    if len(marks[0]) == 0:
        return None
    return float(np.sqrt(np.mean(ray_gaps(first, second, *marks) ** 2)))
