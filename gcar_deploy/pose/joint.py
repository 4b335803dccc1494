"""Pose of three or more views at once, from the epipolar consistency of every pair.

One pair sees a shift along the normal of its own epipolar planes alone. A third view that does
not lie in the plane of the first two has another normal with each of them, so what is hidden
from one pair is seen by the next: all pairs together form one least-squares problem, in which
only directions that no pair sees are left to the prior.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from gcar_deploy.config import PoseOptions
from gcar_deploy.geometry.carm import CArm, separation_deg
from gcar_deploy.geometry.consistency import Mass, disagreement, mass_profiles, mismatch
from gcar_deploy.geometry.epipolar import plane_normal, ray_gaps
from gcar_deploy.geometry.prior import LANDMARK_MM, OFFSET_MM
from gcar_deploy.pose.profile_fit import (
    MOST_APART_DEG,
    SEARCH_MM,
    STEP_MM,
    fit_profiles,
    prior_root,
    prior_sigmas,
    tolerances,
)
from gcar_deploy.types import Array, Scalars

#: directions nearer than this tell nothing of each other; and from how many starts the views'
#: offsets are sought together
LEAST_APART_DEG = 10.0
STARTS = 60
#: steps of that search at most, and the drop of the misfit (in variances) that ends it
NEWTON_STEPS, LEAST_GAIN = 60, 1e-6
#: differences of profiles that are kept, some 10 kB each
MOST_KNOWN = 256
#: more views than this are corrected pair by pair alone
MOST_JOINT_VIEWS = 4
#: pairs that disagree by no more than this as they are told, are left alone (four views of one
#: tree, exactly placed, pixels of 1.4 mm: up to 0.08)
AGREED = 0.09


def corrected(carm: CArm, theta: Array) -> CArm:
    """Return the view after ``theta``: offset x, y, z in mm, primary and secondary in degrees."""
    if not theta.any():
        return carm
    if theta[3] or theta[4]:
        return carm.turned(float(theta[3]), float(theta[4]), theta[:3])
    return carm.moved(theta[:3])


def estimate_jointly(
    masses: Sequence[Mass | None], first: Array, options: PoseOptions, marks: Array
) -> tuple[Array, bool]:
    """Estimate the corrections of all views but the first from all pairs.

    Parameters
    ----------
    masses : V views, as they are told
    first : (V, 5) corrections found pair by pair, the first of them zero: one of the starts
    options : PoseOptions
    marks : (m, V, 2) landmarks, (col, row), nan where not seen

    Returns
    -------
    theta : (V, 5) corrections; ``first`` where fewer than three pairs can be compared, where
        there are more views than ``MOST_JOINT_VIEWS`` (the cost grows with their cube), where all
        pairs agree as they are told, or where they do not agree better after the joint fit
    converged : bool, False where the joint fit stopped at its cap
    """
    seen = {k: mass for k, mass in enumerate(masses) if mass is not None}
    problem = _Problem(seen, options, marks)
    if len(problem.pairs) < 3 or len(seen) > MOST_JOINT_VIEWS:
        return first, True
    if not first.any() and max(problem.disagreements(first)) <= AGREED:
        return first, True
    theta, converged = problem.fitted(problem.shifts(first))
    if problem.mean_disagreement(theta) >= problem.mean_disagreement(first):
        return first, True
    return problem.without_the_needless(theta), converged


@dataclasses.dataclass(frozen=True, eq=False)
class _Problem:
    """All pairs that can be compared, and the priors; ``seen`` are the views with vessels."""

    seen: dict[int, Mass]
    options: PoseOptions
    marks: Array

    @functools.cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """Pairs with vessels whose planes cut slices: neither nearly parallel nor opposite."""
        out = []
        for i, j in itertools.combinations(self.seen, 2):
            apart = separation_deg(self.seen[i].carm, self.seen[j].carm)
            if LEAST_APART_DEG <= apart <= MOST_APART_DEG:
                out.append((i, j))
        return out

    @property
    def noise(self) -> float:
        return tolerances(self.seen.values())[0]

    @property
    def prior(self) -> Array:
        return prior_sigmas()

    @functools.cached_property
    def roots(self) -> dict[int, Array]:
        """Square root of the prior of each view's correction."""
        return {k: prior_root(mass.carm) for k, mass in self.seen.items()}

    @functools.cached_property
    def _known(self) -> dict[tuple[float | bytes, ...], Any]:
        """Views and differences of late: a step of one view leaves the pairs of others as is."""
        return {}

    def placed(self, k: int, theta: Array) -> Mass:
        """Return a view with its correction built in."""
        key = (k, theta[k].tobytes())
        if key not in self._known:
            mass = self.seen[k]
            self._keep(key, dataclasses.replace(mass, carm=corrected(mass.carm, theta[k])))
        mass = self._known[key]
        return mass

    def pair(self, i: int, j: int, theta: Array) -> tuple[Mass, Mass, CArm]:
        """Both views with the correction of the first built in, and the second's C-arm."""
        return self.placed(i, theta), self.seen[j], self.placed(j, theta).carm

    def differences(self, i: int, j: int, theta: Array, sigma_mm: float) -> Scalars:
        """Profile of one view minus that of the other, as shares of its norm."""
        key = (i, j, sigma_mm, theta[i].tobytes(), theta[j].tobytes())
        if key not in self._known:
            a, b = mass_profiles(*self.pair(i, j, theta), sigma_mm)
            self._keep(key, (a - b) / np.sqrt(float(a @ a)))
        out: Scalars = self._known[key]
        return out

    def _keep(self, key: tuple[float | bytes, ...], value: Any) -> None:
        if len(self._known) >= MOST_KNOWN:
            self._known.clear()
        self._known[key] = value

    def residuals(self, x: Array, sigma_mm: float, noise: float) -> Scalars:
        """All differences, landmark gaps and corrections over their standard deviations."""
        theta = _with_first(x)
        parts = [
            self.roots[k] @ t if k in self.seen else t / self.prior
            for k, t in enumerate(theta[1:], start=1)
        ]
        for i, j in self.pairs:
            parts.append(self.differences(i, j, theta, sigma_mm) / noise)
            seen = self.marks[np.isfinite(self.marks[:, [i, j]]).all(axis=(1, 2))]
            if len(seen):
                fixed, _, carm = self.pair(i, j, theta)
                gaps = ray_gaps(fixed.carm, carm, seen[:, i], seen[:, j])
                parts.append(gaps / LANDMARK_MM)
        return np.concatenate(parts)

    def left(self, x: Array, sigma_mm: float) -> float:
        """Root mean square mismatch over the pairs."""
        theta = _with_first(x)
        values = [mismatch(*self.pair(*p, theta), sigma_mm) for p in self.pairs]
        return float(np.sqrt(np.mean(np.square(values))))

    def disagreements(self, theta: Array, view: int | None = None) -> list[float]:
        """Of every pair, or of those of one view, 0 (equal) .. 1 (disjoint)."""
        pairs = [p for p in self.pairs if view is None or view in p]
        return [disagreement(*self.pair(*p, theta), self.options.fine_mm) for p in pairs]

    def mean_disagreement(self, theta: Array, view: int | None = None) -> float:
        """Mean over the pairs, or over those of one view."""
        values = self.disagreements(theta, view)
        return float(np.mean(values)) if values else 0.0

    def shifts(self, first: Array) -> Array:
        """(V, 5) start: offsets that suit all pairs best, angles zero.

        A shift moves a pair's profiles against each other by its share along the pair's normal.
        So each pair is asked once for its misfit at every such shift, and the offsets are sought
        on those curves, from many starts: profiles that are far off have many local minima.
        """
        # Of three and more views alone, and 0.1 s to import.
        from scipy.interpolate import CubicSpline

        steps = np.arange(-2 * SEARCH_MM, 2 * SEARCH_MM + 1e-9, STEP_MM)
        zero, curves = np.zeros_like(first), []
        # Row by row, how far the offsets of views 1, 2, ... move a pair along its normal.
        along = np.zeros((len(self.pairs), len(first), 3))
        for row, (i, j) in enumerate(self.pairs):
            fixed, moving, _ = self.pair(i, j, zero)
            normal = plane_normal(fixed.carm, moving.carm)
            misfit = []
            for step in steps:
                at = zero.copy()
                at[j, :3] = step * normal
                apart = self.differences(i, j, at, self.options.coarse_mm) / self.noise
                misfit.append(float(np.sum(apart**2)))
            curves.append(CubicSpline(steps, misfit, bc_type="clamped").c)
            along[row, j], along[row, i] = normal, -normal
        rng = np.random.default_rng(0)
        spread = rng.normal(0.0, 2.0 * OFFSET_MM, (STARTS, 3 * (len(first) - 1)))
        starts = np.stack([first[1:, :3].ravel(), np.zeros(spread.shape[1]), *spread])
        out = zero.copy()
        out[1:, :3] = _lowest(
            starts, along[:, 1:].reshape(len(curves), -1), np.stack(curves, axis=2), steps
        ).reshape(-1, 3)
        return out

    def fitted(self, theta: Array) -> tuple[Array, bool]:
        """(V, 5) offsets and angles together, from coarse to fine profiles; did they converge."""
        prior = np.tile(self.prior, len(theta) - 1)
        calibrated = all(mass.calibrated for mass in self.seen.values())
        x, converged = fit_profiles(
            self.residuals, self.left, theta[1:].ravel(), prior, self.options,
            calibrated=calibrated, noise=self.noise,
        )  # fmt: skip
        return _with_first(x), converged

    def without_the_needless(self, theta: Array) -> Array:
        """Leave a view alone whose correction does not clearly help it to agree."""
        _, least_gain = tolerances(self.seen.values())
        for k in range(1, len(theta)):
            less = theta.copy()
            less[k] = 0.0
            alone = self.mean_disagreement(less, k)
            if self.mean_disagreement(theta, k) > least_gain * alone:
                theta = less
        return theta


def _with_first(x: Array) -> Array:
    """(V, 5) corrections from the unknowns: the first view stays."""
    return np.vstack([np.zeros(5), x.reshape(-1, 5)])


def _lowest(starts: Array, along: Array, cubic: Array, steps: Scalars) -> Scalars:
    """(n,) offsets with the least misfit, by damped Newton steps from all starts at once.

    Parameters
    ----------
    starts : (S, n) offsets, mm
    along : (P, n) so that ``along @ x`` are the shifts of the P pairs, mm
    cubic : (4, intervals, P) coefficients of each pair's misfit against its shift
    steps : (intervals + 1,) shifts in mm at which the intervals meet, evenly; constant beyond
    """
    which = np.arange(len(along))

    def told(x: Array) -> tuple[Scalars, Array, Array]:
        """Misfit (S,), and slope and curvature of every pair's share of it (S, P)."""
        shift = np.minimum(np.maximum(x @ along.T, steps[0]), steps[-1])
        piece = ((shift - steps[0]) / (steps[1] - steps[0])).astype(np.int64)
        piece = np.minimum(piece, len(steps) - 2)
        h, (a, b, c, e) = shift - steps[piece], cubic[:, piece, which]
        value = np.sum((x / OFFSET_MM) ** 2, axis=1) + np.sum(((a * h + b) * h + c) * h + e, axis=1)
        return value, (3.0 * a * h + 2.0 * b) * h + c, 6.0 * a * h + 2.0 * b

    x, share = starts, np.ones(len(starts))
    value, slope, bend = told(x)
    prior = 2.0 / OFFSET_MM**2
    for _ in range(NEWTON_STEPS):
        # The curvature's size: where it is negative too, the step goes downhill.
        H = np.einsum("sp,pi,pj->sij", np.abs(bend), along, along) + prior * np.eye(x.shape[1])
        step = np.linalg.solve(H, (prior * x + slope @ along)[..., None])[..., 0]
        trial = x - share[:, None] * step
        then, *rest = told(trial)
        better = then < value
        gain = np.max(np.where(better, value - then, 0.0))
        share = np.where(better, np.minimum(2.0 * share, 1.0), 0.25 * share)
        x, value = np.where(better[:, None], trial, x), np.where(better, then, value)
        slope, bend = (
            np.where(better[:, None], n, o) for n, o in zip(rest, (slope, bend), strict=True)
        )
        if better.any() and gain < LEAST_GAIN:
            break
    lowest: Scalars = x[np.argmin(value)]
    return lowest
