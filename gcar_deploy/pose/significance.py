"""Whether the pictures ask for another angle, or another scale, of a view than it is told with.

The pose estimate holds angles to their prior: in raw pictures it leaves alone what does not help
clearly. Here a view is turned, or its pixels are scaled, without any such prior, each beside a
shift along the line that two views see best (tables move). What is left of the difference of the
mass profiles is compared with what the shift alone leaves: that is the noise of this very pair.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
import scipy  # its optimize is imported where it is first used: most runs never need it

from gcar_deploy.config import RunOptions
from gcar_deploy.geometry.carm import CArm, separation_deg
from gcar_deploy.geometry.consistency import (
    Mass,
    disagreement,
    mass_profiles,
    mismatch,
    uncovered_mm,
)
from gcar_deploy.geometry.epipolar import plane_normal
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.pose.agreement import profiled
from gcar_deploy.pose.pairwise import Pose
from gcar_deploy.pose.profile_fit import MOST_APART_DEG, SEARCH_MM, STEP_MM, covers
from gcar_deploy.types import Array, Scalars

#: fits go so far at most, standard deviations: shift in mm, two angles in deg, log of the scale
_REACH = np.array([30.0, 8.0, 8.0, 0.15])
#: one step of each, which the fit counts in, and the error of a profile as a share of its norm
_UNIT, _NOISE = np.array([1.0, 1.0, 1.0, 0.02]), 0.1
_SHIFT, _TURN, _SCALE = [0], [0, 1, 2], [0, 3]
_MOST_STEPS = 15
#: Exact pictures that differ by no more than this, and whose squared difference falls by less than
#: this factor where slopes are followed to their end, ask for nothing: that is half of what is
#: significant (``asked_gain``), and as near to what fits gain as 5 % where that is up to 1.5
_SMALL, _WORTH_A_FIT = 0.03, 1.15
#: slopes are differences over such a share of a step
_SLOPE_SHARE = 0.05


@dataclasses.dataclass(frozen=True, kw_only=True)
class Asked:
    """What one view asks for against its partner.

    Attributes
    ----------
    view, partner : numbers from 0
    turn_deg : larger of the two angle corrections
    scale : factor that the view's pixels are too small by
    given : disagreement after the best shift alone, 0 .. 1
    turned, scaled : the same with turn or scale as well
    turn_gain, scale_gain : how many times more the squared difference is without them
    uncovered_mm : length across the epipolar planes that one view alone shows vessel on, mm
    """

    view: int
    partner: int
    turn_deg: float
    scale: float
    given: float
    turned: float
    scaled: float
    turn_gain: float
    scale_gain: float
    uncovered_mm: float


def asked(
    views: Sequence[VesselImage], poses: Sequence[Pose], options: RunOptions
) -> tuple[Asked, ...]:
    """Ask every view what it would have otherwise, against the partner of its pose.

    Parameters
    ----------
    views : V vessel images as they are told
    poses : V estimated corrections; the partners' are built in
    options : RunOptions
    """
    # Where less differs than a correction must win, nothing can be asked for.
    open_ = [
        (k, own) for k, own in enumerate(poses)
        if own.partner != k and own.before > options.quality.asked_least
    ]  # fmt: skip
    if not open_:
        return ()
    masses, pose = profiled(views, options)
    out = []
    for k, own in open_:
        fixed, moving = masses[own.partner], masses[k]
        if fixed is None or moving is None:
            continue
        placed = dataclasses.replace(fixed, carm=poses[own.partner].applied(fixed.carm))
        pair = Pair(placed, moving, pose.coarse_mm, pose.fine_mm)
        if separation_deg(placed.carm, moving.carm) < MOST_APART_DEG and not (
            own.before <= _SMALL and pair.content
        ):
            out.append(_asked(k, own.partner, pair))
    return tuple(out)


@dataclasses.dataclass(frozen=True, eq=False)
class Pair:
    """Two views, and the coarse and fine smoothing of their profiles, mm."""

    fixed: Mass
    moving: Mass
    coarse_mm: float
    fine_mm: float

    def changed(self, x: Array) -> tuple[Mass, CArm]:
        """Apply shift, primary, secondary and log scale of the pixels to the moving view."""
        carm = self.moving.carm
        normal = plane_normal(self.fixed.carm, carm)
        middle = np.array(carm.principal_point)
        pixels = middle + np.exp(x[3]) * (self.moving.pixels - middle)
        if x[1] or x[2]:
            carm = carm.turned(float(x[1]), float(x[2]))
        return dataclasses.replace(self.moving, pixels=pixels), carm.moved(x[0] * normal)

    @property
    def content(self) -> bool:
        """Whether exact pictures gain nothing by turn or scale, as far as slopes tell."""
        if not (self.fixed.calibrated and self.moving.calibrated):
            return False
        rest = self.residuals(np.zeros(4), self.fine_mm)
        steps = np.diag(_UNIT) * _SLOPE_SHARE
        slopes = np.stack([self.residuals(x, self.fine_mm) - rest for x in steps], axis=1)
        by_shift, *others = (
            rest - slopes[:, free] @ np.linalg.lstsq(slopes[:, free], rest)[0]
            for free in (_SHIFT, _TURN, _SCALE)
        )
        return all(by_shift @ by_shift < _WORTH_A_FIT * (left @ left) for left in others)

    @functools.cached_property
    def start(self) -> float:
        """Shift in mm alone that makes the coarse profiles agree best."""

        def apart(shift: float) -> float:
            x = np.array([shift, 0.0, 0.0, 0.0])
            rest = self.residuals(x, self.coarse_mm)
            return float(np.sum(np.append(rest, shift / _REACH[0]) ** 2))

        shifts = np.linspace(-SEARCH_MM, SEARCH_MM, round(2 * SEARCH_MM / STEP_MM) + 1)
        return float(min(shifts, key=apart))

    def residuals(self, x: Array, sigma_mm: float) -> Scalars:
        """(bins,) difference of the profiles, in units of its error."""
        a, b = mass_profiles(self.fixed, *self.changed(x), sigma_mm)
        out: Scalars = (a - b) / (_NOISE * np.sqrt(float(a @ a)))
        return out

    def fitted(self, free: list[int]) -> Array:
        """(4,) what makes the profiles agree best where only ``free`` may change."""

        def whole(y: Scalars) -> Array:
            x = np.zeros(4)
            x[free] = y * _UNIT[free]
            return x

        def residuals(y: Scalars, sigma_mm: float) -> Scalars:
            x = whole(y)
            out: Scalars = np.concatenate([self.residuals(x, sigma_mm), x[free] / _REACH[free]])
            return out

        y = np.zeros(len(free))
        y[0] = self.start
        for sigma_mm in (2 * self.coarse_mm, self.coarse_mm, self.fine_mm):
            y = scipy.optimize.least_squares(
                residuals, y, args=(sigma_mm,), diff_step=1e-2, max_nfev=_MOST_STEPS
            ).x
        return whole(y)

    def uncovered_mm(self, x: Array) -> float:
        """Return what one view alone covers."""
        return uncovered_mm(self.fixed, *self.changed(x))

    def left(self, x: Array) -> tuple[float, float]:
        """Squared difference as a share of the norm, and disagreement."""
        moving, carm = self.changed(x)
        return (
            mismatch(self.fixed, moving, carm, self.fine_mm) ** 2,
            disagreement(self.fixed, moving, carm, self.fine_mm),
        )


def _asked(view: int, partner: int, pair: Pair) -> Asked:
    shift = pair.fitted(_SHIFT)
    given = pair.left(shift)
    turn, scale = pair.fitted(_TURN), pair.fitted(_SCALE)
    # What does not let both pictures cover the same planes is not what they ask for.
    told = min(pair.uncovered_mm(np.zeros(4)), pair.uncovered_mm(shift))
    turned, scaled = (
        pair.left(x) if covers(pair.fixed, *pair.changed(x), told) else given for x in (turn, scale)
    )
    return Asked(
        view=view, partner=partner, turn_deg=float(np.abs(turn[1:3]).max()),
        scale=float(np.exp(scale[3])), given=given[1], turned=turned[1], scaled=scaled[1],
        turn_gain=given[0] / max(turned[0], 1e-12), scale_gain=given[0] / max(scaled[0], 1e-12),
        uncovered_mm=told,
    )  # fmt: skip
