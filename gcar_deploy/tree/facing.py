"""Free ends of separate parts that face each other over a gap, and the vessel between them."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np

from gcar_deploy.tree.edit import merged
from gcar_deploy.tree.tree import Branch, Tree, along
from gcar_deploy.types import Points

#: either end may point so far beside the other, degrees
MOST_TURN_DEG = 50.0
#: an end's direction is taken over so much of its branch, mm
DIRECTION_MM = 4.0
#: a shorter part bridges nothing, mm: scraps point anywhere
LEAST_PART_MM = 8.0
#: distance between the points of a bridge, mm
STEP_MM = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class FreeEnd:
    """A free end: node, branch, number of its point, place, direction outwards, widest radius."""

    node: int
    branch: int
    point: int
    place: Points
    outwards: Points
    radius_mm: float


#: gives the branch from one end to the other along a line between, (m, 3) mm; None leaves the gap
Bridge = Callable[[FreeEnd, FreeEnd, Points], Branch | None]


def joined_ends(
    tree: Tree, bridge: Bridge, most_gap_mm: float, least_branch_mm: float = LEAST_PART_MM
) -> Tree:
    """Join ends of separate parts that face each other, the shortest gap first.

    Parameters
    ----------
    tree : Tree, mm
    bridge : asked of each gap in turn, along a smooth curve from end to end
    most_gap_mm : no longer gap is asked for
    least_branch_mm : nor one at the end of a shorter branch

    Returns
    -------
    Tree, the same one where nothing is joined
    """
    if len(tree.branches) < 2:
        return tree
    ends, component = _free_ends(tree, least_branch_mm), tree.components()
    wanted = [
        (gap, a, b)
        for a, b in itertools.combinations(ends, 2)
        if (gap := float(np.linalg.norm(b.place - a.place))) <= most_gap_mm
        and component[a.node] != component[b.node]
        and _face(a, b, gap)
    ]
    used: set[int] = set()
    bridges = []
    for gap, a, b in sorted(wanted, key=lambda item: item[0]):
        if component[a.node] == component[b.node] or {a.node, b.node} & used:
            continue
        made = bridge(a, b, _curve(a, b, gap))
        if made is None:
            continue
        used |= {a.node, b.node}
        component[component == component[b.node]] = component[a.node]
        bridges.append(made)
    if not bridges:
        return tree
    return merged(dataclasses.replace(tree, branches=(*tree.branches, *bridges)))


def _free_ends(tree: Tree, least_branch_mm: float) -> list[FreeEnd]:
    degrees, out = tree.degrees, []
    whole = tree.part_lengths_mm()[tree.parts()]
    for k, branch in enumerate(tree.branches):
        if whole[k] < LEAST_PART_MM or branch.length_mm < least_branch_mm:
            continue
        arc = branch.arc_mm
        for point, node, inner in (
            (0, branch.start, min(DIRECTION_MM, arc[-1])),
            (-1, branch.end, max(arc[-1] - DIRECTION_MM, 0.0)),
        ):
            if degrees[node] == 1:
                way = branch.points_mm[point] - along(branch.points_mm, arc, np.array(inner))
                way /= max(float(np.linalg.norm(way)), 1e-9)
                near = np.abs(arc - arc[point]) <= DIRECTION_MM
                radius = float(branch.radius_mm[near].max())
                out.append(FreeEnd(node, k, point, branch.points_mm[point], way, radius))
    return out


def _face(a: FreeEnd, b: FreeEnd, gap: float) -> bool:
    way = b.place - a.place
    if gap == 0 or max(a.radius_mm, b.radius_mm) > 2 * min(a.radius_mm, b.radius_mm):
        return False
    least = np.cos(np.radians(MOST_TURN_DEG))
    return bool(a.outwards @ way >= least * gap and -(b.outwards @ way) >= least * gap)


def _curve(a: FreeEnd, b: FreeEnd, gap: float) -> Points:
    """(m, 3) Hermite's cubic from one end to the other."""
    t = np.linspace(0, 1, max(5, int(np.ceil(gap / STEP_MM)) + 1))[:, None]
    out: Points = (
        (2 * t**3 - 3 * t**2 + 1) * a.place + (t**3 - 2 * t**2 + t) * gap * a.outwards
        + (3 * t**2 - 2 * t**3) * b.place - (t**3 - t**2) * gap * b.outwards
    )  # fmt: skip
    return out
