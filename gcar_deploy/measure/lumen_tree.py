"""The lumen as a tree of its own: a point a section, where the tubes' points lie further apart.

A narrow core is shorter than the distance of the tubes' points: between them a third of the loss
behind a stenosis would be missed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gcar_deploy.measure.sections import Sections, sections_of_radii
from gcar_deploy.tree.tree import Branch, Tree, along


def lumen_tree(
    tree: Tree, sections: Sequence[Sections] | None
) -> tuple[Tree, tuple[Sections, ...]]:
    """Return a tree of the same course with a point at each section, and its sections.

    Parameters
    ----------
    tree : Tree, mm LPS
    sections : of its branches; None takes its own points and radii

    Returns
    -------
    tree whose radii are the sections', and the sections, their arcs measured along it
    """
    if sections is None:
        return tree, sections_of_radii(tree)
    branches = tuple(
        section_branch(
            along(branch.points_mm, branch.arc_mm, own.arc_mm),
            own.diameter_mm, branch.start, branch.end,
        )
        for branch, own in zip(tree.branches, sections, strict=True)
    )  # fmt: skip
    moved = tuple(
        dataclasses.replace(own, arc_mm=branch.arc_mm)
        for branch, own in zip(branches, sections, strict=True)
    )
    return dataclasses.replace(tree, branches=branches), moved


def section_branch(points_mm: np.ndarray, diameter_mm: np.ndarray, start: int, end: int) -> Branch:
    """Branch of (m, 3) points and (m,) diameters, of whose position nothing is stated."""
    count = len(points_mm)
    return Branch(
        points_mm=points_mm, radius_mm=0.5 * diameter_mm, sigma_mm=np.full(count, np.nan),
        confidence=np.ones(count), start=start, end=end,
    )  # fmt: skip
