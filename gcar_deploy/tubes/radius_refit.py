"""Radii once more, with the axes held: what smooths a vessel's course rounds off a stenosis.

The fit of ``gauss_newton`` has to find where a vessel runs, and its prior on the radius, a random
walk of the logarithm with Gaussian steps, keeps ghosts and overlaps from bending it. A narrow core
pays for its two steep flanks there. When the axes stand, the pictures' own pixels say more about
the radius, and the steps may be rare and large: their prior is Student's t,

    0.5 (nu + 1) log(1 + z^2 / nu),   z = step of log radius / (walk sqrt(gap in mm)),

by reweighting (the weight of a step is (nu + 1) / (nu + z^2); Lange, Little and Taylor, J Am Stat
Assoc 84:881, 1989). Neighbours along a branch are all that couples, so each step is tridiagonal.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.linalg import solveh_banded

from gcar_deploy.config import TubeOptions
from gcar_deploy.tubes.gauss_newton import (
    MAX_LOG_STEP,
    RADIUS_BOUNDS_MM,
    footprints,
    sums_of,
    weights_of,
)
from gcar_deploy.tubes.model import Footprint, Tubes
from gcar_deploy.tubes.targets import Target, exact_paths
from gcar_deploy.types import Scalars

#: noise of the path length, mm
NOISE_MM = 0.15
#: walk of the log radius: scale, 1 / sqrt(mm), and Student's degrees of freedom
WALK, FREEDOM = 0.2, 3.0
#: reweightings of the prior for each look at the pictures
_REWEIGHTINGS = 3


def refit_radii(
    tubes: Tubes, targets: list[Target], prints: list[Footprint], options: TubeOptions
) -> tuple[Tubes, list[Footprint]]:
    """Refit the radii of tubes whose axes stand.

    Parameters
    ----------
    tubes : Tubes after the last level
    targets : of the pictures' own pixels
    prints : where the tubes fall in them
    options : TubeOptions; ``radius_refit_steps``

    Returns
    -------
    tubes, and where they fall; as given where a picture is not calibrated, whose contrast would
    have to be guessed along with the radii, or where a step leaves the finite numbers
    """
    if not exact_paths(targets) or not len(tubes.log_radius):
        return tubes, prints
    sharp = [
        dataclasses.replace(target, sigma_mm=NOISE_MM + options.noise_share * target.path_mm)
        for target in targets
    ]
    low, high = np.log(RADIUS_BOUNDS_MM)
    for _ in range(options.radius_refit_steps):
        step = _step(tubes, sharp, prints, options)
        if not np.isfinite(step).all():
            break
        radius = np.clip(tubes.log_radius + step, low, high)
        tubes = dataclasses.replace(tubes, log_radius=radius)
        prints = footprints(tubes, targets, prints)
    return tubes, prints


def _step(
    tubes: Tubes, targets: list[Target], prints: list[Footprint], options: TubeOptions
) -> Scalars:
    """(n,) bounded step of the log radii that the pictures and the prior want."""
    diagonal, beside, pull = _pictures(tubes, targets, prints, options)
    x0 = tubes.log_radius
    a, b = tubes.first, tubes.second
    gap = np.maximum(np.linalg.norm(tubes.points_mm[b] - tubes.points_mm[a], axis=1), 1e-3)
    stiff = 1.0 / (WALK**2 * gap)
    wanted = pull + diagonal * x0
    wanted[:-1] += beside[:-1] * x0[1:]
    wanted[1:] += beside[:-1] * x0[:-1]
    x = x0
    for _ in range(_REWEIGHTINGS):
        nu = FREEDOM
        q = stiff * (nu + 1) / (nu + stiff * (x[b] - x[a]) ** 2)
        n = len(x0)
        band = np.stack([diagonal + np.bincount(a, q, n) + np.bincount(b, q, n) + 1e-9, beside])
        band[1, a] -= q
        x = solveh_banded(band, wanted + 1e-9 * x0, lower=True, check_finite=False)
    step: Scalars = np.clip(x - x0, -MAX_LOG_STEP, MAX_LOG_STEP)
    return step


def _pictures(
    tubes: Tubes, targets: list[Target], prints: list[Footprint], options: TubeOptions
) -> tuple[Scalars, Scalars, Scalars]:
    """Gauss-Newton terms of the pictures over the log radii: diagonal, beside it, pull, (n,)."""
    n = len(tubes.log_radius)
    diagonal, beside, pull = np.zeros(n), np.zeros(n), np.zeros(n)
    for target, seen in zip(targets, prints, strict=True):
        weight, error = weights_of(target, seen, options)
        t, slope = seen.t, seen.d_log_radius
        s = 1 - t
        # Crossings majorise the coupling of vessels that share a ray, as in ``gauss_newton``.
        curve = weight * seen.crossings * slope**2
        force = weight * error * slope
        of_first, of_second, of_both, *forces = sums_of(
            seen, np.stack([curve * s * s, curve * t * t, curve * s * t, force * s, force * t])
        )
        diagonal[tubes.first] += of_first
        diagonal[tubes.second] += of_second
        beside[tubes.first] += of_both
        pull[tubes.first] += forces[0]
        pull[tubes.second] += forces[1]
    return diagonal, beside, pull
