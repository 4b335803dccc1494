"""Adaptive density control: clone, split and prune, each a pure function that keeps mass."""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.gaussians.gaussians import Gaussians, concatenate
from gcar_deploy.types import Array

#: a split puts the halves this many standard deviations to each side along the longest axis
SPLIT_SIGMAS = 0.8


def clone(gaussians: Gaussians, chosen: Array) -> Gaussians:
    """Replace each chosen Gaussian by two of half its intensity in the same place.

    Returns
    -------
    Gaussians, the copies appended at the end; total mass unchanged
    """
    intensity = gaussians.intensity.copy()
    intensity[chosen] *= 0.5
    halved = dataclasses.replace(gaussians, intensity=intensity)
    return concatenate([halved, halved.select(chosen)])


def split(gaussians: Gaussians, chosen: Array) -> Gaussians:
    """Replace each chosen Gaussian by two halves side by side along its longest axis.

    Mass and, along that axis, the second moment are kept: sigma'^2 = sigma^2 (1 - a^2) for
    halves at +-a sigma.
    """
    n = len(gaussians)
    index = np.arange(n)[chosen]
    axis = np.argmax(gaussians.scales_mm[index], axis=1)
    row = np.arange(len(index))
    direction = gaussians.rotations()[index, :, axis]
    scales = gaussians.scales_mm.copy()
    longest = scales[index, axis]
    shrink = np.sqrt(1 - SPLIT_SIGMAS**2)
    scales[index, axis] = longest * shrink
    intensity = gaussians.intensity.copy()
    intensity[index] *= 0.5 / shrink
    means = gaussians.means_mm.copy()
    means[index] += SPLIT_SIGMAS * longest[:, None] * direction
    changed = dataclasses.replace(gaussians, means_mm=means, scales_mm=scales, intensity=intensity)
    other = changed.select(index)
    shifted = other.means_mm - 2 * SPLIT_SIGMAS * longest[row, None] * direction
    return concatenate([changed, dataclasses.replace(other, means_mm=shifted)])


def prune(
    gaussians: Gaussians, least_mass_mm3: float, bounds_mm: Array | None = None
) -> tuple[Gaussians, dict[str, int]]:
    """Drop what no longer matters.

    Parameters
    ----------
    least_mass_mm3 : mass below which a Gaussian goes
    bounds_mm : (2, 3) lowest and highest mean allowed, or None

    Returns
    -------
    the rest, and how many went for which reason
    """
    light = gaussians.masses_mm3() < least_mass_mm3
    outside = np.zeros(len(gaussians), bool)
    if bounds_mm is not None:
        outside = ((gaussians.means_mm < bounds_mm[0]) | (gaussians.means_mm > bounds_mm[1])).any(1)
    reasons = {"light": int(light.sum()), "outside": int((outside & ~light).sum())}
    return gaussians.select(~(light | outside)), reasons


def most_wanting(gradient: Array, threshold: float, room: int) -> Array:
    """Return at most ``room`` Gaussians whose position gradient (n,) exceeds the threshold.

    The steepest first; ties by index, so the answer is one.
    """
    wanting = np.flatnonzero(gradient > threshold)
    order = np.argsort(-gradient[wanting], kind="stable")
    chosen: Array = np.sort(wanting[order][: max(room, 0)])
    return chosen
