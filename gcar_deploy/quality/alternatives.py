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
from gcar_deploy.geometry.epipolar import plane_angles, reach_mm
from gcar_deploy.quality.shown import CELLS_OFF, CELLS_ON, Shown
from gcar_deploy.tree.edit import kept_branches
from gcar_deploy.tree.tree import Branch, Tree
from gcar_deploy.types import Array, Scalars

#: stretches shorter than this are left out, mm
MIN_LENGTH_MM = 20.0
#: a branch with a free end that is shorter than this is a spur, which parts no vessel in two, mm
SPUR_MM = 10.0
#: a vessel turns back where it goes on by at least so much on either side, mm across the planes
TURN_MM = 4.0
#: profiles are compared in bins of this width at the isocentre, smoothed over a bin
BIN_MM = 2.0
#: vessels whose profiles differ by less than this share could be each other's. Ten trees: 0.19
#: and more between branches with a free end, 0.01 to 0.13 between parallel bars of one width
MOST_DIFFERENCE = 0.15
#: ... and of masks, whose widths differ by less than this share: halves of rings 0.02 to 0.04,
#: stretches of ten real left and ten right trees 0.11 and more; none of 80 generated pairs that
#: were ok is below
MOST_WIDTH_DIFFERENCE = 0.05
#: mean share of a ray's evidence that lies in other places. Eight trees: 0.001 to 0.1
MOST_ELSEWHERE = 0.12


@dataclasses.dataclass(frozen=True, kw_only=True)
class Exchange:
    """Two stretches of vessel that the pictures would let change partners.

    Attributes
    ----------
    branches : numbers of both in the tree, from 0; the same where it turns back
    stretches_mm : from, to along each branch
    difference : share of what the pictures show of them per epipolar plane that differs,
        0 (equal) .. 1
    """

    branches: tuple[int, int]
    stretches_mm: tuple[tuple[float, float], tuple[float, float]]
    difference: float


def findings(alternatives: Sequence[Exchange], elsewhere: float | None) -> list[str]:
    """Say what is left open, as reasons for ``degraded``."""
    out = []
    if alternatives:
        a, b = (end - start for start, end in alternatives[0].stretches_mm)
        first, second = (k + 1 for k in alternatives[0].branches)
        both = first == second
        whose = f"both of branch {first}" if both else f"branches {first} and {second}"
        more = f" (and {len(alternatives) - 1} more pairs)" if len(alternatives) > 1 else ""
        out.append(
            f"two vessels of {a:.0f} and {b:.0f} mm ({whose}) could "
            f"be exchanged between the views without a trace in the pictures{more}: they may lie "
            "elsewhere; a third view would tell"
        )
    if elsewhere is not None and elsewhere > MOST_ELSEWHERE:
        out.append(
            f"{elsewhere:.0%} of what may be vessel along the beams lies off the tree (at most "
            f"{MOST_ELSEWHERE:.0%} is usual): branches may lie elsewhere"
        )
    return out


def exchanges(tree: Tree, carms: Sequence[CArm], *, masks: bool = False) -> tuple[Exchange, ...]:
    """Find vessels that could be exchanged; none with three views or more.

    Parameters
    ----------
    tree : Tree
    carms : the views
    masks : whether the pictures show no more than where vessel is
    """
    if len(carms) != 2:
        return ()
    whole = [((number,), branch) for number, branch in enumerate(tree.branches)]
    ways = [
        way
        for numbers, vessel in (*whole, *_past_spurs(tree))
        for way in _ways(tree, numbers, vessel, carms, masks)
    ]
    if len(ways) < 2:
        return ()
    low = min(way.at_mm.min() for way in ways) - 2 * BIN_MM
    high = max(way.at_mm.max() for way in ways) + 2 * BIN_MM
    profiles = [_profile(way.at_mm, way.shown, low, high) for way in ways]
    most = MOST_WIDTH_DIFFERENCE if masks else MOST_DIFFERENCE
    found = []
    for a, b in itertools.combinations(range(len(ways)), 2):
        one, two = ways[a], ways[b]
        if one.numbers != two.numbers and set(one.numbers) & set(two.numbers):
            # A vessel and a branch of its own.
            continue
        shown = float(profiles[a].sum() + profiles[b].sum())
        difference = float(np.abs(profiles[a] - profiles[b]).sum()) / max(shown, 1e-9)
        if difference < most:
            found.append(
                Exchange(
                    branches=(one.branch, two.branch),
                    stretches_mm=(one.stretch_mm, two.stretch_mm),
                    difference=difference,
                )
            )
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


@dataclasses.dataclass(frozen=True, eq=False)
class _Way:
    """A stretch of a vessel that crosses the epipolar planes one way.

    Attributes
    ----------
    numbers : of the branches that the vessel consists of
    branch, stretch_mm : the longest of them; from, to along it
    at_mm : (n,) epipolar plane of each segment, mm at the isocentre
    shown : (n,) what the pictures show of each: its volume, mm^3, or, of masks, its radius times
        the planes that it crosses, mm^2
    """

    numbers: tuple[int, ...]
    branch: int
    stretch_mm: tuple[float, float]
    at_mm: Scalars
    shown: Scalars


def _past_spurs(tree: Tree) -> list[tuple[tuple[int, ...], Branch]]:
    """Vessels that spurs part into several branches, each with the numbers of those."""
    free = tree.degrees == 1
    spur = np.array(
        [one.length_mm < SPUR_MM and (free[one.start] or free[one.end]) for one in tree.branches],
        dtype=bool,
    )
    out = []
    for vessel in kept_branches(tree, ~spur).branches:
        own = [
            number
            for number in np.flatnonzero(~spur).tolist()
            if (vessel.points_mm == _middle(tree.branches[number])).all(axis=1).any()
        ]
        if len(own) > 1:
            out.append((tuple(own), vessel))
    return out


def _middle(branch: Branch) -> Array:
    return branch.points_mm[len(branch) // 2]


def _ways(
    tree: Tree, numbers: tuple[int, ...], vessel: Branch, carms: Sequence[CArm], masks: bool
) -> list[_Way]:
    """Cut a vessel of these branches where it turns back; stretches of some length."""
    longest = max(numbers, key=lambda number: tree.branches[number].length_mm)
    ends = (0.0, tree.branches[longest].length_mm) if len(numbers) > 1 else None
    arc = vessel.arc_mm
    pixels, _ = carms[0].project(vessel.points_mm)
    at = plane_angles(carms[0], carms[1], carms[0], pixels) * reach_mm(carms[0], carms[1])
    radius = 0.5 * (vessel.radius_mm[1:] + vessel.radius_mm[:-1])
    shown = radius * np.abs(np.diff(at)) if masks else np.pi * radius**2 * np.diff(arc)
    middle = 0.5 * (at[1:] + at[:-1])
    return [
        _Way(numbers, longest, ends or (float(arc[i]), float(arc[j])), middle[i:j], shown[i:j])
        for i, j in itertools.pairwise(turning_points(at, TURN_MM))
        if arc[j] - arc[i] >= MIN_LENGTH_MM
    ]


def turning_points(values: Scalars, least: float) -> list[int]:
    """Return the first and last place, and where a series turns: ``least`` on either side."""
    out, low, high, rising = [0], 0, 0, 0
    for k, value in enumerate(values):
        high = k if value > values[high] else high
        low = k if value < values[low] else low
        if rising >= 0 and values[high] - value > least:
            # What it did before it first went far in one direction is no turn.
            out += [high] if rising else []
            rising, low = -1, k
        elif rising <= 0 and value - values[low] > least:
            out += [low] if rising else []
            rising, high = 1, k
    return [*out, len(values) - 1]


def _profile(at: Scalars, mass: Scalars, low: float, high: float) -> Array:
    count = int(np.ceil((high - low) / BIN_MM)) + 1
    place = (at - low) / BIN_MM
    base = np.floor(place).astype(np.int64)
    part = place - base
    out = np.bincount(base, mass * (1 - part), count + 1)
    out += np.bincount(base + 1, mass * part, count + 1)
    return np.convolve(out, [0.25, 0.5, 0.25], mode="same")
