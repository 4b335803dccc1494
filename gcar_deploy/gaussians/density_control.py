"""Adaptive density control: clone, split and prune, each a pure function that keeps mass."""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.gaussians.gaussians import Gaussians, concatenate
from gcar_deploy.types import Array

#: a split puts the halves this many standard deviations to each side along the longest axis
SPLIT_SIGMAS = 0.8
#: distance of a clone from its twin, in the smallest standard deviation: enough to part them,
#: too little to show (the pair's second moment grows by 1 %)
CLONE_SIGMAS = 0.2


def clone(gaussians: Gaussians, chosen: Array, pull: Array) -> Gaussians:
    """Replace each chosen Gaussian by two of half its intensity, ``CLONE_SIGMAS`` apart.

    Two equal Gaussians in one place have equal gradients and would stay one for ever, so the
    pair is set apart along the pull.

    Parameters
    ----------
    chosen : (m,) indices
    pull : (m, 3) position gradients of the chosen; zero pulls along x

    Returns
    -------
    Gaussians, the copies appended at the end; mass and its centre unchanged
    """
    intensity = gaussians.intensity.copy()
    intensity[chosen] *= 0.5
    length = np.linalg.norm(pull, axis=1, keepdims=True)
    # A floor on the length alone would lose the direction of very small gradients.
    direction = np.where(length > 0, pull / np.where(length > 0, length, 1.0), [1.0, 0.0, 0.0])
    smallest = gaussians.scales_mm[chosen].min(axis=1, keepdims=True)
    offset = 0.5 * CLONE_SIGMAS * smallest * direction
    means = gaussians.means_mm.copy()
    means[chosen] -= offset
    halved = dataclasses.replace(gaussians, means_mm=means, intensity=intensity)
    copies = halved.select(chosen)
    copies = dataclasses.replace(copies, means_mm=copies.means_mm + 2 * offset)
    return concatenate([halved, copies])


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
