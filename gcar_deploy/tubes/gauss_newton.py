"""Gauss-Newton fit of a tube tree to path-length pictures.

Unknowns: the position of every centreline point and the log of its radius. Objective:

    sum over pixels of rho((path - contrast * model) / sigma) * area     (Cauchy, IRLS)
    + bending + taper + distance from the start                          (prior)

Points couple along the branch only, apart from shared bifurcations, so the normal equations are
banded and one step costs what the vessels' length costs. Rays through several vessels weigh each
by the number of crossings, which majorises the coupling that is left out (Jacobi's bound): steps
stay descent steps. A step that does not lower the objective is rejected and damped further.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from gcar_deploy.config import TubeOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.tubes.arrow import Arrow
from gcar_deploy.tubes.model import Footprint, Tubes, footprint
from gcar_deploy.tubes.prior import Prior, columns_of
from gcar_deploy.tubes.targets import Target, exact_paths
from gcar_deploy.types import Array, Scalars

#: a level ends when a step lowers the objective by less than this share
TOLERANCE = 3e-3
#: bounds of the radius, mm.
RADIUS_BOUNDS_MM = (0.2, 5.0)
#: a step never moves a point or a log radius by more than this.
MAX_MOVE_MM = 1.5
MAX_LOG_STEP = 0.4
#: rejected steps in a row after which a level gives up.
MAX_REJECTED = 5
#: share of its length that a step keeps in the next one; single ratios jump with the damping
SHRINK = 3 / 4


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ending:
    """How the last level of a fit ended.

    Attributes
    ----------
    converged : bool
        A step lowered the objective by less than ``TOLERANCE``, or none lowered it; False where
        the fit was stopped first, at its cap of steps or by a deadline.
    steps : int
        Of that level.
    left_mm : float
        How far going on would still move the tree's points on average: the last step's mean length
        as a geometric series of ratio ``SHRINK``.
    """

    converged: bool
    steps: int
    left_mm: float


@dataclasses.dataclass(eq=False)
class Progress:
    """What a fit did so far.

    Attributes
    ----------
    losses : list of float
        Objective where each fit starts and after each accepted step; a new level starts a new
        scale.
    steps, rejected : int
    stopped : bool
        The caller asked to stop (deadline or cancel).
    failed : bool
        The objective was not finite.
    ending : Ending or None
        Of the last level.
    """

    losses: list[float] = dataclasses.field(default_factory=list)
    steps: int = 0
    rejected: int = 0
    stopped: bool = False
    failed: bool = False
    ending: Ending | None = None

    def follow(self, later: Progress) -> None:
        """Add what a fit did that went on from here."""
        self.losses += later.losses
        self.steps += later.steps
        self.rejected += later.rejected
        self.ending = later.ending


def fit_level(
    tubes: Tubes,
    targets: list[Target],
    prior: Prior,
    options: TubeOptions,
    steps: int,
    progress: Progress,
    should_stop: Callable[[], bool] | None = None,
) -> tuple[Tubes, list[Footprint]]:
    """Run up to ``steps`` damped Gauss-Newton steps; returns the best tubes, and their prints."""
    damping = 1e-3
    prints = footprints(tubes, targets)
    targets = rescaled(targets, prints)
    loss = objective(tubes, targets, prints, prior, options)
    progress.losses.append(loss)
    if not np.isfinite(loss):
        progress.failed = True
        return tubes, prints
    move, taken, converged = 0.0, 0, False
    for _ in range(steps):
        if should_stop is not None and should_stop():
            progress.stopped = True
            break
        hessian, gradient = normal_equations(tubes, targets, prints, prior, options)
        for _attempt in range(MAX_REJECTED):
            trial = moved(tubes, _solve(hessian, gradient, damping))
            trial_prints = footprints(trial, targets, prints)
            value = objective(trial, targets, trial_prints, prior, options)
            if np.isfinite(value) and value < loss:
                break
            damping = max(damping * 10, 1e-2)
            progress.rejected += 1
        else:
            converged = True
            break
        damping = max(damping * 0.3, 1e-4)
        gain = (loss - value) / max(abs(loss), 1e-12)
        move = float(np.linalg.norm(trial.positions_mm - tubes.positions_mm, axis=1).mean())
        taken += 1
        tubes, prints, loss = trial, trial_prints, value
        targets = rescaled(targets, prints)
        if not exact_paths(targets):
            # The next step has to beat the objective under the contrast it is judged by.
            loss = objective(tubes, targets, prints, prior, options)
        progress.steps += 1
        progress.losses.append(loss)
        if gain < TOLERANCE:
            converged = True
            break
    left = move * SHRINK / (1.0 - SHRINK)
    progress.ending = Ending(converged=converged, steps=taken, left_mm=left)
    return tubes, prints


def footprints(
    tubes: Tubes, targets: list[Target], before: list[Footprint] | None = None
) -> list[Footprint]:
    """Project the tubes into every target; ``before`` is an earlier result, for its pairs."""
    pairings = [None] * len(targets) if before is None else [seen.pairing for seen in before]
    return [
        footprint(tubes, target.carm, target.box_px, pairing, target.shown)
        for target, pairing in zip(targets, pairings, strict=True)
    ]


def rescaled(targets: list[Target], prints: list[Footprint]) -> list[Target]:
    """Refit the contrast of pictures that are not calibrated."""
    return [
        target if target.calibrated else target.with_contrast(seen.covered, seen.totals())
        for target, seen in zip(targets, prints, strict=True)
    ]


def objective(
    tubes: Tubes,
    targets: list[Target],
    prints: list[Footprint],
    prior: Prior,
    options: TubeOptions,
) -> float:
    """Return the objective (half the sum of squares where nothing is robust)."""
    total = prior.value(unknowns(tubes))
    c2 = options.robust_sigmas**2
    for target, seen in zip(targets, prints, strict=True):
        # Pixels without a tube cost what they cost an empty model.
        pixel = seen.covered
        path = target.path_mm.reshape(-1)[pixel]
        sigma = target.sigma_mm.reshape(-1)[pixel]
        z2 = ((path - target.contrast * seen.totals()) / sigma) ** 2
        change = np.log1p(z2 / c2) - np.log1p((path / sigma) ** 2 / c2)
        cost = target.empty_cost + float((change * target.weight.reshape(-1)[pixel]).sum())
        total += data_term(target, cost, options)
    return total


def empty_objective(targets: list[Target], options: TubeOptions) -> float:
    """Return the objective of a model without tubes."""
    return sum(data_term(target, target.empty_cost, options) for target in targets)


def data_term(target: Target, cost: float, options: TubeOptions) -> float:
    """Return what a picture adds to the objective; ``cost`` as ``Target.empty_cost``."""
    return 0.5 * options.robust_sigmas**2 * cost * target.pixel_mm**2


def normal_equations(
    tubes: Tubes,
    targets: list[Target],
    prints: list[Footprint],
    prior: Prior,
    options: TubeOptions,
) -> tuple[Arrow, Scalars]:
    """Hessian (Gauss-Newton, majorised) and gradient over the unknowns."""
    count = len(tubes.first)
    size = 3 * len(tubes.positions_mm) + len(tubes.log_radius)
    blocks = np.zeros((count, 8, 8))
    pull = np.zeros((count, 8))
    for target, seen in zip(targets, prints, strict=True):
        if not len(seen.pixel):
            continue
        w, e = weights_of(target, seen, options)
        # Each crossing counts as often as there are: the bound of the couplings left out.
        basis = basis_of(seen)
        moments = moments_of(seen, basis, w * seen.crossings * target.contrast**2)
        pulls = sums_of(seen, basis * (w * e * target.contrast)).T
        M = to_unknowns(tubes, target.carm)
        blocks += M @ moments @ np.swapaxes(M, 1, 2)
        pull += (M @ pulls[:, :, None])[:, :, 0]
    gradient = prior.gradient(unknowns(tubes))
    gradient -= np.bincount(columns_of(tubes).reshape(-1), pull.reshape(-1), minlength=size)
    return prior.added(blocks), gradient


def weights_of(target: Target, seen: Footprint, options: TubeOptions) -> tuple[Scalars, Scalars]:
    """(e,) weight of each entry's pixel, 1 / mm^2, and (e,) what the model leaves of its path."""
    path, sigma, weight = (
        picture.reshape(-1)[seen.covered]
        for picture in (target.path_mm, target.sigma_mm, target.weight)
    )
    left = path - target.contrast * seen.totals()
    robust = 1.0 / (1.0 + (left / (options.robust_sigmas * sigma)) ** 2)
    weight = weight * robust * (target.pixel_mm / sigma) ** 2
    return weight[seen.group], left[seen.group]


def basis_of(seen: Footprint) -> Array:
    """(6, e) derivatives of an entry's path: by both ends' pixels (col, row) and log radii."""
    both = np.concatenate([seen.d_axis, seen.d_log_radius[None]])
    second = both * seen.t
    first = both - second
    return np.concatenate([first[:2], second[:2], first[2:], second[2:]])


def moments_of(seen: Footprint, basis: Array, weight: Scalars) -> Array:
    """(s, 6, 6) weighted sums of products of the derivatives over each segment's entries."""
    weighed = weight * basis
    one, other = np.triu_indices(6)
    sums = sums_of(seen, np.concatenate([basis[a:] * weighed[a] for a in range(6)]))
    out = np.empty((6, 6, sums.shape[1]))
    out[one, other] = out[other, one] = sums
    return np.moveaxis(out, -1, 0)


def sums_of(seen: Footprint, values: Array) -> Array:
    """(k, s) sums of (k, e) values over each segment's entries."""
    count = len(seen.pairing.count)
    some, first = seen.pairing.starts
    if len(some) == count > 0:
        whole: Array = np.add.reduceat(values, first, axis=1)
        return whole
    out = np.zeros((len(values), count))
    if len(some):
        out[:, some] = np.add.reduceat(values, first, axis=1)
    return out


def to_unknowns(tubes: Tubes, carm: CArm) -> Array:
    """(s, 8, 6) from derivatives by pixels and log radii to those by a segment's unknowns."""
    J = np.swapaxes(carm.jacobian(tubes.points_mm), 1, 2)
    out = np.zeros((len(tubes.first), 8, 6))
    out[:, 0:3, 0:2] = J[tubes.first]
    out[:, 3:6, 2:4] = J[tubes.second]
    out[:, 6, 4] = out[:, 7, 5] = 1.0
    return out


def _solve(hessian: Arrow, gradient: Scalars, damping: float) -> Scalars:
    """Damped step; NaN, which no one accepts, where the matrix is not positive definite."""
    factor = hessian.damped(damping, 1e-9).factorised()
    return np.full(len(gradient), np.nan) if factor is None else factor.solve(-gradient)


def unknowns(tubes: Tubes) -> Scalars:
    """All unknowns as one vector: positions, then log radii."""
    return np.concatenate([tubes.positions_mm.reshape(-1), tubes.log_radius])


def moved(tubes: Tubes, step: Scalars) -> Tubes:
    """Apply a step, bounded in length and in radius."""
    split = 3 * len(tubes.positions_mm)
    move = step[:split].reshape(-1, 3)
    length = np.linalg.norm(move, axis=1, keepdims=True)
    move = move * np.minimum(1.0, MAX_MOVE_MM / np.maximum(length, 1e-12))
    grow = np.clip(step[split:], -MAX_LOG_STEP, MAX_LOG_STEP)
    low, high = np.log(RADIUS_BOUNDS_MM)
    return dataclasses.replace(
        tubes,
        positions_mm=tubes.positions_mm + move,
        log_radius=np.clip(tubes.log_radius + grow, low, high),
    )
