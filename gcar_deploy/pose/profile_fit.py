"""Least squares on mass profiles: from coarse to fine, and from a wide error to a narrow one.

How far two profiles of one tree differ for other reasons than geometry is not known beforehand:
in calibrated pictures it may be 0.1 % (pixels alone), in raw ones 20 %. So calibrated pictures
are fitted with a tenth of the difference that is left as its error, again and again as long as
that lowers it. What is left in the end counts as one standard deviation, all of the profile
together as one measurement: a mismatch of other causes makes the priors strong again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import scipy  # its optimize is imported where it is first used: most runs never need it

from gcar_deploy.config import PoseOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.consistency import Mass, uncovered_mm
from gcar_deploy.geometry.prior import ANGLE_DEG, MAGNIFICATION, OFFSET_MM
from gcar_deploy.types import Array, Scalars

#: first search along the direction that two views see best, mm
SEARCH_MM, STEP_MM = 12.0, 1.0
#: how well two profiles of the same tree agree, as a share of their norm, and how well at best in
#: calibrated pictures
PROFILE_NOISE, CALIBRATED_NOISE = 0.05, 0.002
#: of masks: where vessels overlap, one of them counts. On 24 generated pairs as placed the
#: disagreement is 0.07 .. 0.19, and a pose lowers it to no less than 0.82 of that; with this noise
#: what it cannot see stays half as large as with ``PROFILE_NOISE``
MASK_NOISE = 0.1
#: directions further apart than this are not compared: see ``estimate_poses``
MOST_APART_DEG = 150.0
#: a correction must lower the disagreement to this share of what it was
MIN_GAIN, MASK_MIN_GAIN = 0.85, 0.9
#: and, of masks, leave no more than this share of what only one of them covers
MASK_UNCOVERED = 0.75
#: looks at the profiles after which a fit stops where it is: more than pairs of one tree need
MAX_EVALUATIONS = 120
#: relative change of the objective or of the pose below which a fit ends
TOLERANCE = 1e-4
#: finite differences reach so far, as a share of a parameter's prior
STEP_SHARE = 3e-3
#: digits of a correction that the pictures can tell, mm and deg
DIGITS = 4
#: error of the next fit, as a share of the difference that the last one left: small enough for
#: the pictures to outweigh the priors of an angle that is 3 deg off
TRIAL_SHARE = 0.1
#: bound of the number of fits; each lowers what is left
MOST_FITS = 12
#: what pictures of masks, or of a heart that moved, tell of a pose: shift across the planes, two
#: angles. A shift within them shows in exact profiles of a rigid tree alone
FREE = 3
#: (pose, smoothing in mm, error of a profile) -> residuals in standard deviations
Residuals = Callable[[Array, float, float], Scalars]


def fit_profiles(
    residuals: Residuals, left: Callable[[Array, float], float], start: Array, prior: Array,
    options: PoseOptions, *, calibrated: bool, noise: float = PROFILE_NOISE,
) -> tuple[Array, bool]:  # fmt: skip
    """Find the pose parameters under which the profiles agree best, given their priors.

    Parameters
    ----------
    residuals : see ``Residuals``
    left : (pose, smoothing in mm) -> difference of the profiles as a share of their norm
    start, prior : (n,) starting values and standard deviations of the pose parameters
    options : PoseOptions
    calibrated : bool, all pictures hold path lengths in mm
    noise : of the profiles where they do not, as a share of their norm

    Returns
    -------
    x : (n,)
    converged : bool, False where the fit that gave ``x`` was stopped by ``MAX_EVALUATIONS``
    """
    steps = STEP_SHARE * np.diag(prior)
    last: tuple[object, Scalars] = None, np.empty(0)

    def told(x: Array, sigma: float, noise: float) -> Scalars:
        nonlocal last
        last = (x.tobytes(), sigma, noise), residuals(x, sigma, noise)
        return last[1]

    def slopes(x: Array, sigma: float, noise: float) -> Array:
        # Steps of the priors' size: a share of the value itself means nothing near zero. The
        # solver asks for slopes where it has just asked for residuals.
        asked = x.tobytes(), sigma, noise
        here = last[1] if last[0] == asked else residuals(x, sigma, noise)
        ahead = [residuals(x + step, sigma, noise) - here for step in steps]
        return np.stack(ahead, axis=1) / np.diag(steps)

    def fitted(x: Array, sigma: float, noise: float) -> tuple[Array, bool]:
        solution = scipy.optimize.least_squares(
            told, x, jac=slopes, args=(sigma, noise), x_scale=prior,
            ftol=TOLERANCE, xtol=TOLERANCE, max_nfev=MAX_EVALUATIONS,
        )  # fmt: skip
        return np.round(solution.x, DIGITS), bool(solution.status > 0)

    if not calibrated:
        x, _ = fitted(start, options.coarse_mm, noise)
        return fitted(x, options.fine_mm, noise)
    x, now = start, left(start, options.fine_mm)
    if now > PROFILE_NOISE:
        x, _ = fitted(x, options.coarse_mm, PROFILE_NOISE)
        now = left(x, options.fine_mm)
    for _ in range(MOST_FITS):
        error = max(TRIAL_SHARE * min(now, PROFILE_NOISE), CALIBRATED_NOISE)
        trial, converged = fitted(x, options.fine_mm, error)
        then = left(trial, options.fine_mm)
        if then > MIN_GAIN * now:
            break  # what is left is not the pose's
        x, now = trial, then
        if error == CALIBRATED_NOISE:
            return x, converged
    return fitted(x, options.fine_mm, max(now, CALIBRATED_NOISE))


def covers(fixed: Mass, moving: Mass, carm: CArm, told_mm: float) -> bool:
    """Whether a correction lets both pictures show vessel on the same planes, as it should.

    Where vessels overlap, masks (and saturated pictures) hold less mass than there is, and a move
    can make the profiles look more alike; which planes hold any vessel knows of no overlap.

    Parameters
    ----------
    fixed, moving, carm : as of ``mass_profiles``, ``carm`` and ``moving`` corrected
    told_mm : float, what one view alone covered before (``uncovered_mm``)
    """
    if fixed.calibrated and moving.calibrated:
        return True
    most = MASK_UNCOVERED if fixed.mask or moving.mask else 1.0
    return uncovered_mm(fixed, moving, carm) <= most * told_mm


def tolerances(masses: Iterable[Mass]) -> tuple[float, float]:
    """Error of a profile, and share of the disagreement that a correction must come below."""
    mask = any(mass.mask for mass in masses)
    return (MASK_NOISE, MASK_MIN_GAIN) if mask else (PROFILE_NOISE, MIN_GAIN)


def pair_theta(x: Array, normal: Array) -> Array:
    """(5,) correction of a view from its first ``FREE`` unknowns, mm and deg.

    Parameters
    ----------
    x : (n,) unknowns; those of a motion may follow
    normal : (3,) across the epipolar planes (``plane_normal``)
    """
    out: Array = np.concatenate([x[0] * normal, x[1:FREE]])
    return out


def prior_sigmas() -> Array:
    """(5,) standard deviations of a view's correction: offset x, y, z in mm, two angles in deg."""
    return np.array([OFFSET_MM] * 3 + [ANGLE_DEG] * 2)


def prior_root(carm: CArm) -> Array:
    """(5, 5) W with W theta standard normal under the prior of a view's correction.

    A magnification off by a share m shows as a move of m times the source distance along the
    beam, so the prior is wider there: else that part would be made up for by a move across.
    """
    beam = carm.axes[2]
    along = np.hypot(OFFSET_MM, MAGNIFICATION * np.linalg.norm(carm.source_mm))
    W = np.eye(5) / ANGLE_DEG
    W[:3, :3] = np.eye(3) / OFFSET_MM
    W[:3, :3] += (1.0 / along - 1.0 / OFFSET_MM) * np.outer(beam, beam)
    return W
