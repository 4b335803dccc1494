"""Gauss-Newton fit of a tube tree to path-length pictures.

Unknowns: the position of every centreline point and the log of its radius. Objective:

    sum over pixels of rho((path - contrast * model) / sigma) * area     (Cauchy, IRLS)
    + bending + taper + distance from the start                          (tube_prior)

Points couple along the branch only, apart from shared bifurcations, so the normal equations are
banded and one step costs what the vessels' length costs. Rays through several vessels weigh each
by the number of crossings, which majorises the coupling that is left out (Jacobi's bound): steps
stay descent steps. A step that does not lower the objective is rejected and damped further.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from gcar_deploy.config import TubeOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.refine.targets import Target
from gcar_deploy.refine.tube_model import Footprint, Tubes, footprint
from gcar_deploy.refine.tube_prior import Prior
from gcar_deploy.types import Array, Scalars

#: bounds of the radius, mm.
RADIUS_BOUNDS_MM = (0.2, 5.0)
#: a step never moves a point or a log radius by more than this.
MAX_MOVE_MM = 1.5
MAX_LOG_STEP = 0.4
#: rejected steps in a row after which a level gives up.
MAX_REJECTED = 5


@dataclasses.dataclass(eq=False)
class Progress:
    """What a fit did so far.

    Attributes
    ----------
    losses : list of float
        Objective after each accepted step; a new level starts a new scale.
    steps, rejected : int
    stopped : bool
        The caller asked to stop (deadline or cancel).
    failed : bool
        The objective was not finite.
    """

    losses: list[float] = dataclasses.field(default_factory=list)
    steps: int = 0
    rejected: int = 0
    stopped: bool = False
    failed: bool = False


def fit_level(
    tubes: Tubes,
    targets: list[Target],
    prior: Prior,
    options: TubeOptions,
    steps: int,
    progress: Progress,
    should_stop: Callable[[], bool] | None = None,
) -> Tubes:
    """Run up to ``steps`` damped Gauss-Newton steps; returns the best tubes found."""
    damping = 1e-3
    prints = footprints(tubes, targets)
    targets = rescaled(targets, prints)
    loss = objective(tubes, targets, prints, prior, options)
    progress.losses.append(loss)
    if not np.isfinite(loss):
        progress.failed = True
        return tubes
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
            break
        damping = max(damping * 0.3, 1e-4)
        gain = (loss - value) / max(abs(loss), 1e-12)
        tubes, prints, loss = trial, trial_prints, value
        targets = rescaled(targets, prints)
        progress.steps += 1
        progress.losses.append(loss)
        if gain < options.tolerance:
            break
    return tubes


def footprints(
    tubes: Tubes, targets: list[Target], before: list[Footprint] | None = None
) -> list[Footprint]:
    """Project the tubes into every target; ``before`` is an earlier result, for its pairs."""
    pairings = [None] * len(targets) if before is None else [seen.pairing for seen in before]
    return [
        footprint(tubes, target.carm, target.box_px, pairing)
        for target, pairing in zip(targets, pairings, strict=True)
    ]


def rescaled(targets: list[Target], prints: list[Footprint]) -> list[Target]:
    """Refit the contrast of pictures that are not calibrated."""
    return [
        target if target.calibrated else target.with_contrast(seen.image(target.path_mm.shape))
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
        model = target.contrast * seen.image(target.path_mm.shape)
        z2 = ((target.path_mm - model) / target.sigma_mm) ** 2
        total += float((np.log1p(z2 / c2) * target.weight).sum()) * 0.5 * c2 * target.pixel_mm**2
    return total


def normal_equations(
    tubes: Tubes,
    targets: list[Target],
    prints: list[Footprint],
    prior: Prior,
    options: TubeOptions,
) -> tuple[sparse.csc_matrix, Scalars]:
    """Hessian (Gauss-Newton, majorised) and gradient over the unknowns."""
    columns = _columns(tubes)
    count = len(tubes.first)
    size = 3 * len(tubes.positions_mm) + len(tubes.log_radius)
    blocks = np.zeros((8, 8, count))
    gradient = prior.gradient(unknowns(tubes))
    for target, seen in zip(targets, prints, strict=True):
        if not len(seen.pixel):
            continue
        # Sorted by segment, the sums over a segment's entries are matrix products.
        J = _jacobian(tubes, target.carm, seen) * target.contrast
        residual = target.path_mm - target.contrast * seen.image(target.path_mm.shape)
        e = residual.reshape(-1)[seen.pixel]
        sigma = target.sigma_mm.reshape(-1)[seen.pixel]
        robust = 1.0 / (1.0 + (e / (options.robust_sigmas * sigma)) ** 2)
        w = target.weight.reshape(-1)[seen.pixel] * robust * (target.pixel_mm / sigma) ** 2
        order = np.argsort(seen.segment, kind="stable")
        segment = seen.segment[order]
        start = np.flatnonzero(np.concatenate([[True], segment[1:] != segment[:-1]]))
        which = segment[start]
        J = J[:, order]
        pull = np.add.reduceat(J * (w * e)[order], start, axis=1)
        gradient -= np.bincount(columns[which].T.reshape(-1), pull.reshape(-1), minlength=size)
        weighted = J * (w * seen.crossings)[order]
        for a in range(8):
            blocks[a, a:, which] += np.add.reduceat(weighted[a] * J[a:], start, axis=1).T
    for a in range(8):
        blocks[a + 1 :, a] = blocks[a, a + 1 :]
    rows = np.broadcast_to(columns.T[:, None], blocks.shape).reshape(-1)
    cols = np.broadcast_to(columns.T[None, :], blocks.shape).reshape(-1)
    data = sparse.coo_matrix((blocks.reshape(-1), (rows, cols)), shape=(size, size))
    return (data.tocsc() + prior.hessian).tocsc(), gradient


def _columns(tubes: Tubes) -> Array:
    """(s, 8) unknowns of each segment: position a (3), position b (3), log radius a, b."""
    a, b = tubes.owner[tubes.first], tubes.owner[tubes.second]
    axis = np.arange(3)
    offset = 3 * len(tubes.positions_mm)
    return np.concatenate(
        [
            3 * a[:, None] + axis,
            3 * b[:, None] + axis,
            (offset + tubes.first)[:, None],
            (offset + tubes.second)[:, None],
        ],
        axis=1,
    )


def _jacobian(tubes: Tubes, carm: CArm, seen: Footprint) -> Array:
    """(8, e) derivatives of an entry's path by its segment's unknowns."""
    J = carm.jacobian(tubes.points_mm)
    i, j = tubes.first[seen.segment], tubes.second[seen.segment]
    nx, ny = seen.normal[:, 0], seen.normal[:, 1]
    out = np.empty((8, len(i)))
    for row, point, share in ((0, i, 1 - seen.t), (3, j, seen.t)):
        # The distance shrinks when the axis moves towards the pixel.
        pull = -seen.d_distance * share
        for k in range(3):
            out[row + k] = pull * (nx * J[point, 0, k] + ny * J[point, 1, k])
    out[6] = seen.d_log_radius * (1 - seen.t)
    out[7] = seen.d_log_radius * seen.t
    return out


def _solve(hessian: sparse.csc_matrix, gradient: Scalars, damping: float) -> Scalars:
    damped = hessian + sparse.diags(damping * hessian.diagonal() + 1e-9)
    step: Scalars = splu(damped.tocsc(), permc_spec="MMD_AT_PLUS_A").solve(-gradient)
    return step


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
