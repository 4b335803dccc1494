"""Generated vessels joined to a tree, as the runtime's measures take it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from gcar_deploy.measure import from_inlets
from gcar_deploy.tree.tree import Branch, Tree
from gcar_export.scenes.stenosis_cases import Tube

#: a vessel begins on another whose point is this near, mm
JOIN_MM = 1.5


def joined_tree(vessels: Sequence[Tube]) -> Tree:
    """Cut vessels where others leave them, and join them there.

    Parameters
    ----------
    vessels : each begins at its ostium or on one that stands before it
    """
    cuts: list[set[int]] = [{0, len(v.points_mm) - 1} for v in vessels]
    begins: dict[int, tuple[int, int]] = {}
    for k, vessel in enumerate(vessels):
        gaps = [
            np.linalg.norm(other.points_mm - vessel.points_mm[0], axis=1) for other in vessels[:k]
        ]
        if not gaps or min(gap.min() for gap in gaps) > JOIN_MM:
            continue
        j = int(np.argmin([gap.min() for gap in gaps]))
        at = int(np.argmin(gaps[j]))
        cuts[j].add(at)
        begins[k] = (j, at)
    number: dict[tuple[int, int], int] = {}
    nodes: list[np.ndarray] = []
    for k, vessel in enumerate(vessels):
        for at in sorted(cuts[k]):
            if at == 0 and k in begins:
                number[k, 0] = number[begins[k]]
                continue
            number[k, at] = len(nodes)
            nodes.append(vessel.points_mm[at])
    branches = []
    for k, vessel in enumerate(vessels):
        ends = sorted(cuts[k])
        for a, b in itertools.pairwise(ends):
            points = vessel.points_mm[a : b + 1].copy()
            points[0] = nodes[number[k, a]]
            count = b + 1 - a
            branches.append(
                Branch(
                    points_mm=points, radius_mm=vessel.radius_mm[a : b + 1],
                    sigma_mm=np.full(count, np.nan), confidence=np.ones(count),
                    start=number[k, a], end=number[k, b],
                )
            )  # fmt: skip
    return from_inlets(Tree(nodes_mm=np.array(nodes), branches=tuple(branches)))
