"""Where two views leave open which vessel is which, in the pictures and in the predictor's mind.

Two vessels A and B that cross the same epipolar planes have two ghosts: A's ray in view 1 met
with B's in view 2, and the other way round. The ghosts explain both pictures as well as A and B
do where both hold the same mass in every plane; unless the rest of the tree says where they
start, no pixel tells which pair is real. A third view does.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import plane_angles
from gcar_deploy.quality.shown import CELLS_OFF, CELLS_ON, Shown
from gcar_deploy.tree.tree import Branch, Tree
from gcar_deploy.types import Array, Scalars

#: vessels shorter than this are left out, mm
MIN_LENGTH_MM = 20.0
#: profiles are compared in bins of this width at the isocentre, smoothed over a bin
BIN_MM = 2.0
#: vessels whose profiles differ by less than this share could be each other's. Ten trees: 0.19
#: and more between branches with a free end, 0.01 to 0.13 between parallel bars of one width
MOST_DIFFERENCE = 0.15
#: mean share of a ray's evidence that lies in other places. Eight trees: 0.001 to 0.1
MOST_ELSEWHERE = 0.12


@dataclasses.dataclass(frozen=True, kw_only=True)
class Exchange:
    """Two vessels that the pictures would let change partners.

    Attributes
    ----------
    branches : numbers of both in the tree, from 0
    lengths_mm : of both
    difference : share of their mass per epipolar plane that differs, 0 (equal) .. 1
    """

    branches: tuple[int, int]
    lengths_mm: tuple[float, float]
    difference: float


def findings(alternatives: Sequence[Exchange], elsewhere: float | None) -> list[str]:
    """Say what is left open, as reasons for ``degraded``."""
    out = []
    if alternatives:
        a, b = alternatives[0].lengths_mm
        first, second = alternatives[0].branches
        more = f" (and {len(alternatives) - 1} more pairs)" if len(alternatives) > 1 else ""
        out.append(
            f"two vessels of {a:.0f} and {b:.0f} mm (branches {first + 1} and {second + 1}) could "
            f"be exchanged between the views without a trace in the pictures{more}: they may lie "
            "elsewhere; a third view would tell"
        )
    if elsewhere is not None and elsewhere > MOST_ELSEWHERE:
        out.append(
            f"{elsewhere:.0%} of the evidence on the vessels' rays lies in other places (at most "
            f"{MOST_ELSEWHERE:.0%} is usual): branches may lie elsewhere"
        )
    return out


def exchanges(tree: Tree, carms: Sequence[CArm]) -> tuple[Exchange, ...]:
    """Find vessels with a free end that could be exchanged; none with three views or more.

    Parameters
    ----------
    tree : Tree
    carms : the views
    """
    if len(carms) != 2:
        return ()
    degrees = tree.degrees
    loose = [
        number
        for number, b in enumerate(tree.branches)
        if min(degrees[b.start], degrees[b.end]) == 1 and b.length_mm >= MIN_LENGTH_MM
    ]
    if len(loose) < 2:
        return ()
    planes = [_masses(tree.branches[number], carms) for number in loose]
    low = min(at.min() for at, _ in planes) - 2 * BIN_MM
    high = max(at.max() for at, _ in planes) + 2 * BIN_MM
    profiles = [_profile(at, mass, low, high) for at, mass in planes]
    found = []
    for a, b in itertools.combinations(range(len(loose)), 2):
        whole = float(profiles[a].sum() + profiles[b].sum())
        difference = float(np.abs(profiles[a] - profiles[b]).sum()) / max(whole, 1e-9)
        if difference < MOST_DIFFERENCE:
            pair = loose[a], loose[b]
            lengths = (tree.branches[pair[0]].length_mm, tree.branches[pair[1]].length_mm)
            found.append(Exchange(branches=pair, lengths_mm=lengths, difference=difference))
    return tuple(found)


def evidence_elsewhere(shown: Shown) -> float | None:
    """Share of the predictor's confidence on the tree's rays that lies off the tree.

    Returns
    -------
    mean over the points on the tree, each with its worst view; None without a tree or evidence
    """
    evidence = shown.evidence
    if evidence is None or not shown.tree.branches or not len(evidence.points):
        return None
    told = evidence.points
    # What lies far off is at infinity: off in any case, and never on.
    gap, _ = shown.gap
    off = gap > CELLS_OFF * told.spacing_mm
    on = gap < CELLS_ON * told.spacing_mm
    worst = np.zeros(len(told))
    for ray, weight in zip(evidence.ray, evidence.weight, strict=True):
        amount = told.confidence * weight
        whole = np.bincount(ray, amount)
        elsewhere = np.bincount(ray, amount * off) / np.maximum(whole, 1e-9)
        worst = np.maximum(worst, elsewhere[ray])
    total = float(told.confidence[on].sum())
    return float((worst[on] * told.confidence[on]).sum()) / total if total > 0 else None


def _masses(branch: Branch, carms: Sequence[CArm]) -> tuple[Scalars, Scalars]:
    """(n,) epipolar plane of each segment, mm at the isocentre, and (n,) its volume, mm^3."""
    points, radius = branch.points_mm, branch.radius_mm
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)
    pixels, _ = carms[0].project(0.5 * (points[1:] + points[:-1]))
    reach = 0.5 * sum(float(np.linalg.norm(carm.source_mm)) for carm in carms)
    at = plane_angles(carms[0], carms[1], carms[0], pixels) * reach
    return at, np.pi * (0.5 * (radius[1:] + radius[:-1])) ** 2 * length


def _profile(at: Scalars, mass: Scalars, low: float, high: float) -> Array:
    count = int(np.ceil((high - low) / BIN_MM)) + 1
    place = (at - low) / BIN_MM
    base = np.floor(place).astype(np.int64)
    part = place - base
    out = np.bincount(base, mass * (1 - part), count + 1)
    out += np.bincount(base + 1, mass * part, count + 1)
    return np.convolve(out, [0.25, 0.5, 0.25], mode="same")
