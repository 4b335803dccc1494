"""Lesion borders that the user marked in a picture, on the branch that runs there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

from gcar_deploy.config import LesionBorders
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.measure.sections import Sections
from gcar_deploy.tree.tree import Tree, along

#: a branch further from a mark than this is not meant, mm at the isocentre
FARTHEST_MM = 3.0
#: sections where a lesion is narrowest, begins and ends
Spot: TypeAlias = tuple[int, int, int]


def marked_lesions(
    tree: Tree, sections: Sequence[Sections], carms: Sequence[CArm], marks: Sequence[LesionBorders]
) -> tuple[Mapping[int, Sequence[tuple[float, float]]], tuple[str, ...]]:
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
    and a sentence for each mark that no branch passes at both ends
    """
    found: dict[int, list[tuple[float, float]]] = {}
    missed = []
    for number, mark in enumerate(marks, start=1):
        best: tuple[float, int, tuple[float, float]] | None = None
        if mark.view <= len(carms):
            for k, (branch, own) in enumerate(zip(tree.branches, sections, strict=True)):
                points = along(branch.points_mm, branch.arc_mm, own.arc_mm)
                pixels, _ = carms[mark.view - 1].project(points)
                ends = np.array([mark.proximal, mark.distal])
                gap = np.linalg.norm(pixels[:, None] - ends, axis=2)
                at = gap.argmin(axis=0)
                worst = float(gap.min(axis=0).max()) * carms[mark.view - 1].pixel_at_isocenter_mm
                stretch = sorted(own.arc_mm[at].tolist())
                if stretch[0] < stretch[1] and (best is None or worst < best[0]):
                    best = worst, k, (stretch[0], stretch[1])
        if best is None or best[0] > FARTHEST_MM:
            missed.append(
                f"lesion {number}: no branch passes within {FARTHEST_MM:g} mm of both its borders "
                f"in view {mark.view}"
            )
        elif best[2] not in found.setdefault(best[1], []):
            found[best[1]].append(best[2])
    return found, tuple(missed)


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
