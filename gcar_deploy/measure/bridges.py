"""Ends that face each other over a lesion so narrow that no vessel was found in it.

A severe stenosis hides from the extraction of vessels, and the tree is broken where it matters
most. Two free ends of different parts become one vessel again where each points at the other over
a short gap (``tree.facing``), and where every view's own pixels show a line of contrast along the
bridge that no line beside it comes near. A gap in which nothing is seen stays one: an occlusion is
no stenosis.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gcar_deploy.measure.signals import Signal
from gcar_deploy.tree.edit import UNTOLD
from gcar_deploy.tree.facing import DIRECTION_MM, FreeEnd, joined_ends
from gcar_deploy.tree.tree import Branch, Tree, polyline_arc
from gcar_deploy.types import Array, Points, Scalars

#: longest gap, mm
MOST_GAP_MM = 15.0
#: the bridge is looked at in blocks of this length; in each the line may be so far off, mm
BLOCK_MM, OFF_MM = 2.0, 0.8
#: half-width of the line looked for, and how far beside it others are tried, mm
HALF_MM, BESIDE_MM = 0.35, 5.0
#: contrast over its spread beside the bridge from which it is seen: in each view, in their mean
LEAST_Z, MEAN_Z = 1.5, 3.0
#: ... and over that of the ends; their round caps and blur reach so many radii into the gap
LEAST_LEVEL, CAP_RADII = 0.03, 1.5
#: a lumen is no less than this share of what the ends are
LEAST_SHARE = 0.1
_STEP_MM = 0.2


def joined_over_lesions(tree: Tree, signals: Sequence[Signal]) -> Tree:
    """Join free ends that face each other where every view shows a thin vessel between.

    Parameters
    ----------
    tree : Tree, mm LPS
    signals : of each view (``measure.signals``); masks show nothing where no vessel was found,
        and join none

    Returns
    -------
    Tree, the same one where nothing is joined
    """
    return joined_ends(tree, lambda a, b, line: _bridge(tree, a, b, line, signals), MOST_GAP_MM)


def _radii(line: Points, a: FreeEnd, b: FreeEnd, signals: Sequence[Signal]) -> Scalars | None:
    """(m,) radius along a bridge by the contrast against the ends; None where it is not seen."""
    seen = [found for signal in signals if (found := _seen(line, a, b, signal)) is not None]
    if len(seen) < len(signals):
        return None
    clear = np.array([z for z, _ in seen])
    if clear.min() < LEAST_Z or clear.mean() < MEAN_Z:
        return None
    share = np.clip(np.mean([level for _, level in seen], axis=0), LEAST_SHARE, 1.0)
    out: Scalars = share * np.linspace(a.radius_mm, b.radius_mm, len(line))
    return out


def _seen(line: Points, a: FreeEnd, b: FreeEnd, signal: Signal) -> tuple[float, Scalars] | None:
    """Contrast over its spread beside the bridge, and (m,) over that of the ends; None without."""
    if signal.kind == "mask":
        return None
    # The ends' own vessel gives the scale.
    before, after = _back(a), _back(b)
    whole = np.concatenate([before, line, after[::-1]])
    contrast = _contrast(whole, signal)
    if contrast is None:
        return None
    n = len(before)
    offsets = (np.arange(contrast.shape[1]) - contrast.shape[1] // 2) * _STEP_MM
    own = np.abs(offsets) <= OFF_MM + 1e-9
    scale = float(np.median(contrast[:n][:, own].max(axis=1)))
    scale = min(scale, float(np.median(contrast[-n:][:, own].max(axis=1))))
    if not scale > 0:
        return None
    # The ends' own round caps reach into the gap.
    arc = polyline_arc(line)
    low = min(CAP_RADII * a.radius_mm, arc[-1] / 3)
    high = max(arc[-1] - CAP_RADII * b.radius_mm, arc[-1] * 2 / 3)
    gap = (arc >= low) & (arc <= high)
    inner, arc_inner = contrast[n:-n][gap], arc[gap]
    count = max(int((high - low) / BLOCK_MM), 1)
    block = np.minimum(((arc_inner - low) / (high - low) * count).astype(int), count - 1)
    means = np.stack([inner[block == k].mean(axis=0) for k in range(count)])
    width = round(OFF_MM / _STEP_MM)
    best = np.stack([means[:, k - width : k + width + 1].max(axis=1)
                     for k in range(width, means.shape[1] - width)])  # fmt: skip
    total = best.mean(axis=1)
    middle = len(total) // 2
    beside = np.abs(np.arange(len(total)) - middle) * _STEP_MM > 2 * OFF_MM + HALF_MM
    spread = 1.4826 * float(np.median(np.abs(total[beside] - np.median(total[beside]))))
    level = (best[middle] - np.median(total[beside])) / scale
    if level.mean() < LEAST_LEVEL:
        return None
    out: Scalars = np.interp(arc, [arc_inner[block == k].mean() for k in range(count)], level)
    return float((total[middle] - np.median(total[beside])) / max(spread, 1e-9)), out


def _back(end: FreeEnd) -> Points:
    """(4, 3) places on the vessel before an end."""
    return end.place - np.linspace(DIRECTION_MM, 1.0, 4)[:, None] * end.outwards


def _contrast(line: Points, signal: Signal) -> Array | None:
    """(m, k) signal on a line beside the axis less that on either side of it; None if unseen."""
    carm = signal.carm
    pixels, depth = carm.project(line)
    if not (depth > 1.0).all():
        return None
    ahead = np.gradient(pixels, axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    across = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    per_mm = carm.px_per_mm(depth)
    far = BESIDE_MM + OFF_MM + 4 * HALF_MM
    count = int(np.ceil(far / _STEP_MM))
    x = np.arange(-count, count + 1) * _STEP_MM
    value, shown = signal.at(pixels[:, None] + (x * per_mm[:, None])[:, :, None] * across[:, None])
    if not shown.all():
        return None
    value = signal.laws[len(signal.laws) // 2](value)
    half = round(HALF_MM / _STEP_MM)
    kernel = np.ones(2 * half + 1) / (2 * half + 1)
    mean = np.apply_along_axis(np.convolve, 1, value, kernel, mode="same")
    side = 3 * half + 1
    out: Array = mean - 0.5 * (np.roll(mean, side, axis=1) + np.roll(mean, -side, axis=1))
    return out[:, side + half : -(side + half)]


def _bridge(
    tree: Tree, a: FreeEnd, b: FreeEnd, line: Points, signals: Sequence[Signal]
) -> Branch | None:
    """Return the branch between two ends, whose place nobody fitted; None where none is seen."""
    radius_mm = _radii(line, a, b, signals)
    if radius_mm is None:
        return None
    first, second = tree.branches[a.branch], tree.branches[b.branch]
    m, own = len(line), OFF_MM * np.sin(np.linspace(0, np.pi, len(line)))
    sigma = np.linspace(first.sigma_mm[a.point], second.sigma_mm[b.point], m)
    covariance = None
    if first.covariance_mm2 is not None and second.covariance_mm2 is not None:
        ends = first.covariance_mm2[a.point], second.covariance_mm2[b.point]
        share = np.linspace(0, 1, m)[:, None, None, None]
        covariance = (1 - share) * ends[0] + share * ends[1]
        covariance[:, 0] += own[:, None, None] ** 2 * np.eye(3)
    return Branch(
        points_mm=line, radius_mm=radius_mm, sigma_mm=np.hypot(sigma, own),
        confidence=np.full(m, UNTOLD), start=a.node, end=b.node,
        covariance_mm2=covariance,
    )  # fmt: skip
