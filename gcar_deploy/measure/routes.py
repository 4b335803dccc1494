"""Ways through a tree: from a free end that may be the ostium to every other free end."""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.tree.tree import Tree, along, polyline_arc
from gcar_deploy.types import Array, Points, Scalars

#: radius of a free end is taken over so much of its branch, mm
END_MM = 8.0
#: ends tried as ostium, the thickest first; ends of ways, the farthest first; ways looked at
MOST_ROOTS, MOST_TIPS, MOST_WAYS = 6, 16, 2000


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Route:
    """The way from an ostium to a free end.

    Attributes
    ----------
    branches : numbers of the branches, in order
    nodes : numbers of the nodes, one more than branches
    points_mm : (m, 3) along it, mm LPS
    radius_mm : (m,)
    arc_mm : (m,) distance from the ostium
    node_arc_mm : distance of each of ``nodes``
    """

    branches: tuple[int, ...]
    nodes: tuple[int, ...]
    points_mm: Points
    radius_mm: Scalars
    arc_mm: Scalars
    node_arc_mm: tuple[float, ...]

    @property
    def length_mm(self) -> float:
        """Length of the way."""
        return float(self.arc_mm[-1])

    def at(self, arc_mm: Array) -> Points:
        """(k, 3) places at distances from the ostium, which are held to the way's own."""
        return along(self.points_mm, self.arc_mm, arc_mm)

    def until(self, count: int) -> Route:
        """Return the way over its first ``count`` branches."""
        inside = self.arc_mm <= self.node_arc_mm[count] + 1e-6
        return Route(
            branches=self.branches[:count],
            nodes=self.nodes[: count + 1],
            points_mm=self.points_mm[inside],
            radius_mm=self.radius_mm[inside],
            arc_mm=self.arc_mm[inside],
            node_arc_mm=self.node_arc_mm[: count + 1],
        )

    def mean_radius(self, low_mm: float, high_mm: float) -> float:
        """Mean radius between two distances from the ostium."""
        inside = (self.arc_mm >= low_mm) & (self.arc_mm <= high_mm)
        return float(self.radius_mm[inside].mean() if inside.any() else self.radius_mm[-1])


def end_radii(tree: Tree) -> dict[int, float]:
    """Mean radius over the last ``END_MM`` before each free end: node to mm."""
    degrees, out = tree.degrees, {}
    for branch in tree.branches:
        arc = branch.arc_mm
        if degrees[branch.start] == 1:
            out[branch.start] = float(branch.radius_mm[arc <= END_MM].mean())
        if degrees[branch.end] == 1:
            out[branch.end] = float(branch.radius_mm[arc >= arc[-1] - END_MM].mean())
    return out


def routes_from(tree: Tree, root: int) -> list[Route]:
    """Ways from a free end to the farthest others of its component, the longest first."""
    around: dict[int, list[int]] = {}
    for k, branch in enumerate(tree.branches):
        around.setdefault(branch.start, []).append(k)
        around.setdefault(branch.end, []).append(k)
    found: list[tuple[float, tuple[int, ...], tuple[int, ...]]] = []
    open_: list[tuple[float, tuple[int, ...], tuple[int, ...]]] = [(0.0, (), (root,))]
    # A tree has one way to each end; the bound is for what is none.
    while open_ and len(found) < MOST_WAYS:
        length, way, nodes = open_.pop()
        onward = [k for k in around[nodes[-1]] if k not in way[-1:]]
        if way and not onward:
            found.append((length, way, nodes))
        for k in onward:
            branch = tree.branches[k]
            far = branch.end if branch.start == nodes[-1] else branch.start
            if far not in nodes:
                open_.append((length + branch.length_mm, (*way, k), (*nodes, far)))
    found.sort(key=lambda item: (-item[0], item[1]))
    return [_route(tree, way, nodes) for _, way, nodes in found[:MOST_TIPS]]


def _route(tree: Tree, way: tuple[int, ...], nodes: tuple[int, ...]) -> Route:
    points, radius, arcs = [], [], [0.0]
    for k, start in zip(way, nodes[:-1], strict=True):
        branch = tree.branches[k]
        turn = 1 if branch.start == start else -1
        points.append(branch.points_mm[::turn])
        radius.append(branch.radius_mm[::turn])
        arcs.append(arcs[-1] + branch.length_mm)
    line = np.concatenate(points)
    return Route(
        branches=way,
        nodes=nodes,
        points_mm=line,
        radius_mm=np.concatenate(radius),
        arc_mm=polyline_arc(line),
        node_arc_mm=tuple(arcs),
    )
