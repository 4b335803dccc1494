"""Lesion borders that the user marked in a picture, on the branch that runs there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gcar_deploy.config import LesionBorders
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.measure.sections import Sections
from gcar_deploy.tree.tree import Tree, along
from gcar_deploy.types import Scalars

#: a branch further from a mark than this is not meant, mm at the isocentre
FARTHEST_MM = 3.0
#: a border's own diameter is the mean over so much of vessel outside of it, mm
OUTSIDE_MM = 3.0


def marked_lesions(
    tree: Tree, sections: Sequence[Sections], carms: Sequence[CArm], marks: Sequence[LesionBorders]
) -> tuple[Mapping[int, tuple[float, float]], tuple[str, ...]]:
    """Find the stretch that each pair of marks bounds.

    Parameters
    ----------
    tree : Tree, branches from their inlets
    sections : of each branch
    carms : the views that the marks number from 1
    marks : as the user gave them

    Returns
    -------
    branch -> (first, last) distance from its inlet, mm; and a sentence for each mark that no
    branch passes at both ends
    """
    found: dict[int, tuple[float, float]] = {}
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
        else:
            found[best[1]] = best[2]
    return found, tuple(missed)


def between_borders(own: Sections, line: Scalars, stretch: tuple[float, float]) -> Scalars:
    """(m,) reference with a straight line from one border's diameter to the other's.

    A border's diameter is the mean of the sections just outside of it; where none was measured
    there, it is the reference as it was.
    """
    arc, first, last = own.arc_mm, *stretch
    ends = []
    for low, high, at in ((first - OUTSIDE_MM, first, first), (last, last + OUTSIDE_MM, last)):
        near = own.measured & (arc >= low) & (arc <= high)
        whole = float(np.interp(at, arc, line))
        ends.append(float(own.diameter_mm[near].mean()) if near.any() else whole)
    inside = (arc >= first) & (arc <= last)
    return np.where(inside, np.interp(arc, stretch, ends), line)
