"""Lesion borders that the user marked in a picture, on the branches that run there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

from gcar_deploy.config import LesionBorders
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.measure.sections import Sections
from gcar_deploy.tree.tree import Tree, along
from gcar_deploy.types import Array, Scalars

#: a branch further from a mark than this is not meant, mm at the isocentre
FARTHEST_MM = 3.0
#: sections where a lesion is narrowest, begins and ends
Spot: TypeAlias = tuple[int, int, int]
#: where it begins and ends, mm from the inlet of its branch
Stretch: TypeAlias = tuple[float, float]


def marked_lesions(
    tree: Tree, sections: Sequence[Sections], carms: Sequence[CArm], marks: Sequence[LesionBorders]
) -> tuple[Mapping[int, Sequence[Stretch]], tuple[str, ...]]:
    """Find the stretch that each pair of marks bounds.

    Parameters
    ----------
    tree : Tree, branches from their inlets
    sections : of each branch
    carms : the views that the marks number from 1
    marks : as the user gave them

    Returns
    -------
    branch -> (first, last) distance from its inlet, mm, of each stretch that was marked in it;
    and a sentence for each mark that has a stretch in several branches, or in none
    """
    found: dict[int, list[Stretch]] = {}
    said = []
    for number, mark in enumerate(marks, start=1):
        own = _stretches(tree, sections, carms[mark.view - 1 :][:1], mark)
        if isinstance(own, str):
            said.append(f"lesion {number}: {own}")
            continue
        if len(own) > 1:
            numbers = ", ".join(str(k + 1) for k, _ in own)
            said.append(f"lesion {number} crosses a fork: its parts in branches {numbers} are "
                        "measured each by itself")  # fmt: skip
        for k, stretch in own:
            if stretch not in found.setdefault(k, []):
                found[k].append(stretch)
    return found, tuple(said)


def _stretches(
    tree: Tree, sections: Sequence[Sections], seen: Sequence[CArm], mark: LesionBorders
) -> list[tuple[int, Stretch]] | str:
    """Branches and stretches between two borders, along the blood; or why there are none.

    ``seen``: the view that was marked, empty where there is none of its number.
    """
    near: list[tuple[Array, Scalars]] = []  # gaps, mm, and arcs at both borders
    for carm in seen:
        for branch, own in zip(tree.branches, sections, strict=True):
            pixels, _ = carm.project(along(branch.points_mm, branch.arc_mm, own.arc_mm))
            ends = np.array([mark.proximal, mark.distal])
            gap = np.linalg.norm(pixels[:, None] - ends, axis=2) * carm.pixel_at_isocenter_mm
            near.append((gap.min(axis=0), own.arc_mm[gap.argmin(axis=0)]))
    whole = [(float(gap.max()), k) for k, (gap, arc) in enumerate(near) if arc[0] != arc[1]]
    if whole and min(whole)[0] <= FARTHEST_MM:
        k = min(whole)[1]
        return [(k, _sorted(*near[k][1]))]
    beside = [[k for k, (gap, _) in enumerate(near) if gap[end] <= FARTHEST_MM] for end in (0, 1)]
    if not all(beside):
        return f"no branch passes within {FARTHEST_MM:g} mm of both its borders in view {mark.view}"
    # From the inlet on, whichever way round they were marked.
    over = [
        (float(near[a][0][e] + near[b][0][1 - e]), e, way)
        for e in (0, 1) for a in beside[e] for b in beside[1 - e]
        if a != b and (way := _way(tree, a, b))
    ]  # fmt: skip
    if not over:
        pair = [min(ks, key=lambda k: float(near[k][0][e])) for e, ks in enumerate(beside)]
        if pair[0] == pair[1]:
            return f"both its borders are one place of branch {pair[0] + 1}"
        return (
            f"its borders lie on branches {pair[0] + 1} and {pair[1] + 1}, neither of which leads "
            "to the other: mark each by itself"
        )
    _, e, way = min(over)
    lasts = [float(sections[k].arc_mm[-1]) for k in way]
    begins = [float(near[way[0]][1][e]), *(0.0 for _ in way[1:])]
    ends_at = [*lasts[:-1], float(near[way[-1]][1][1 - e])]
    parts = zip(way, begins, ends_at, strict=True)
    return [(k, (first, last)) for k, first, last in parts if first < last]


def _way(tree: Tree, first: int, last: int) -> list[int]:
    """Branches from one to another along the blood; empty where the one does not lead there."""
    into = {branch.end: k for k, branch in enumerate(tree.branches)}
    way = [last]
    while way[0] != first:
        before = into.get(tree.branches[way[0]].start)
        if before is None or before in way:
            return []
        way.insert(0, before)
    return way


def _sorted(a: float, b: float) -> Stretch:
    return (float(min(a, b)), float(max(a, b)))


def beside_marked(found: Sequence[Spot], marked: Sequence[Spot]) -> tuple[list[Spot], list[Spot]]:
    """Return those found that stay, and those that give way.

    One gives way that is narrowest within a marked one. The others end at the marked borders, so
    that a mark beside a graver lesion does not hide it.
    """
    kept, gone = [], []
    for k, first, last in found:
        if any(begin <= k <= end for _, begin, end in marked):
            gone.append((k, first, last))
            continue
        first = max([first, *(end for _, _, end in marked if end < k)])
        last = min([last, *(begin for _, begin, _ in marked if begin > k)])
        kept.append((k, first, last))
    return kept, gone
