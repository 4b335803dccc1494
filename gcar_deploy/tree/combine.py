"""Two trees of one scene: where they differ, and the tree that takes one side's word there.

Parts of either that lie off the other belong together where they share a line of a picture: who
exchanges one of them has to exchange them all, or lines are explained twice and others not at all.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.tree.curves import MIN_RADIUS_MM, resample
from gcar_deploy.tree.edit import NEW_STEP_MM
from gcar_deploy.tree.tree import Branch, Tree, empty_tree, polyline_arc
from gcar_deploy.types import Array, Points, Scalars

#: a point of one tree is that of another whose points lie so near, mm; shorter parts are no matter
SAME_MM, LEAST_MM = 1.0, 4.0
#: parts share a line where so many points of one lie so near to the other in a picture, mm at the
#: isocentre
LINE_MM, SHARED = 0.8, 3
#: a part hangs on the tree where that passes so near to where it began on its own, mm
JOIN_MM = 1.5
#: what is left of a way behind a cut goes too where it is shorter, mm
STUB_MM = 4.0
#: of two ways to an end, that of both trees, or through the new part, is taken if it is at most
#: so many times as long as one that the other tree lacks
DOUBTED_LENGTH = 10.0


@dataclasses.dataclass(frozen=True, eq=False)
class Net:
    """A tree as points and the steps between them.

    Attributes
    ----------
    points_mm, radius_mm, confidence : (n, 3), (n,), (n,)
    steps : (s, 2) neighbours
    """

    points_mm: Points
    radius_mm: Scalars
    confidence: Scalars
    steps: Array

    @staticmethod
    def of(tree: Tree) -> Net:
        """Take the points of a tree; its nodes come first."""
        nodes = len(tree.nodes_mm)
        points, number = [tree.nodes_mm], nodes
        steps: list[tuple[int, int]] = []
        radius, confidence = [np.zeros(nodes)], [np.zeros(nodes)]
        for branch in tree.branches:
            inner = range(number, number + len(branch) - 2)
            number += len(inner)
            steps += itertools.pairwise([branch.start, *inner, branch.end])
            points.append(branch.points_mm[1:-1])
            for out, own in ((radius, branch.radius_mm), (confidence, branch.confidence)):
                out.append(own[1:-1])
                for node, value in ((branch.start, own[0]), (branch.end, own[-1])):
                    out[0][node] = max(out[0][node], value)
        return Net(
            np.concatenate(points),
            np.concatenate(radius),
            np.concatenate(confidence),
            np.array(steps, dtype=np.int64).reshape(-1, 2),
        )

    @property
    def ends(self) -> Array:
        """(n,) whether a point is a free end."""
        ends: Array = np.bincount(self.steps.ravel(), minlength=len(self.points_mm)) == 1
        return ends

    def touching_mm(self, some: Array) -> float:
        """Length of the steps with one or both ends among (n,) bool points, mm."""
        return float(self.lengths_mm(self.steps[some[self.steps].any(axis=1)]).sum())

    def lengths_mm(self, steps: Array) -> Scalars:
        """(s,) length of (s, 2) steps between its points, mm."""
        gaps: Scalars = np.linalg.norm(
            self.points_mm[steps[:, 0]] - self.points_mm[steps[:, 1]], axis=1
        )
        return gaps


@dataclasses.dataclass(frozen=True, eq=False)
class Difference:
    """What of a tree would go, and what of another would come.

    Attributes
    ----------
    old, new : (n,), (m,) bool, points of the one and of the other
    off : (n,) bool, all points of the one that lie off the other
    """

    old: Array
    new: Array
    off: Array


def differences(one: Net, other: Net, carms: Sequence[CArm]) -> list[Difference]:
    """Find where two trees differ: groups of parts that share no line with any outside.

    Parameters
    ----------
    one, other : of which the second may replace the first
    carms : of all views
    """
    nets = one, other
    off = [
        cKDTree(b.points_mm).query(a.points_mm)[0] > SAME_MM if len(b.points_mm) else np.ones(
            len(a.points_mm), bool
        )
        for a, b in (nets, nets[::-1])
    ]  # fmt: skip
    part = [_parts(net, far) for net, far in zip(nets, off, strict=True)]
    count = [int(own.max(initial=-1)) + 1 for own in part]
    shared = np.zeros(count, bool)
    for carm in carms:
        shared |= _sharing(nets, part, count, carm)
    i, j = np.nonzero(shared)
    graph = sparse.csr_matrix((np.ones(len(i)), (i, count[0] + j)), shape=(sum(count),) * 2)
    groups, group = csgraph.connected_components(graph, directed=False)
    out = []
    for k in range(groups if sum(count) else 0):
        old, new = (
            np.isin(own, np.flatnonzero(label == k))
            for own, label in zip(part, np.split(group, [count[0]]), strict=True)
        )
        if max(one.touching_mm(old), other.touching_mm(new)) >= LEAST_MM:
            out.append(Difference(old, new, off[0]))
    return out


def _parts(net: Net, off: Array) -> Array:
    """(n,) number of the connected part that each point with ``off`` is of, -1 for the others."""
    steps = net.steps[off[net.steps].all(axis=1)]
    size = len(net.points_mm)
    graph = sparse.csr_matrix((np.ones(len(steps)), (steps[:, 0], steps[:, 1])), shape=(size, size))
    label = csgraph.connected_components(graph, directed=False)[1]
    out = np.full(size, -1)
    out[off] = np.unique(label[off], return_inverse=True)[1]
    return out


def _sharing(
    nets: tuple[Net, Net], part: Sequence[Array], count: Sequence[int], carm: CArm
) -> Array:
    """Say which parts of both run along one line of a picture, (a, b) bool."""
    own = [np.flatnonzero(number >= 0) for number in part]
    if not all(len(some) for some in own):
        return np.zeros(count, bool)
    pixels = [
        carm.project(net.points_mm[some])[0] * carm.pixel_at_isocenter_mm
        for net, some in zip(nets, own, strict=True)
    ]
    near = cKDTree(pixels[0]).sparse_distance_matrix(
        cKDTree(pixels[1]), LINE_MM, output_type="coo_matrix"
    )
    # Each point counts once for each part that it is near to.
    pairs = np.unique(np.stack([near.row, part[1][own[1][near.col]]]), axis=1)
    out = np.zeros(count, np.int64)
    np.add.at(out, (part[0][own[0][pairs[0]]], pairs[1]), 1)
    return out >= SHARED


def combined(one: Net, other: Net, where: Difference) -> Tree:
    """Return the first tree with the second's word where they differ.

    Ends stay ends, and what both trees have in common stays where it leads to none, but for stubs.
    Loops that arise are opened where the second tree has nothing, if they can be.
    """
    size = len(one.points_mm)
    left = one.steps[~where.old[one.steps].any(axis=1)]
    came = other.steps[where.new[other.steps].any(axis=1)]
    number = np.arange(len(other.points_mm)) + size
    kept = np.setdiff1d(one.steps, np.flatnonzero(where.old))
    border = np.setdiff1d(came, np.flatnonzero(where.new))
    if len(kept) and len(border):
        gap, nearest = cKDTree(one.points_mm[kept]).query(other.points_mm[border])
        number[border] = np.where(gap <= JOIN_MM, kept[nearest], number[border])
    came = number[came]
    came = came[came[:, 0] != came[:, 1]]
    whole = Net(
        np.concatenate([one.points_mm, other.points_mm]),
        np.concatenate([one.radius_mm, other.radius_mm]),
        np.concatenate([one.confidence, other.confidence]),
        np.concatenate([left, came]),
    )
    ends = np.concatenate([one.ends & ~where.old, other.ends & where.new])
    doubted = np.concatenate([where.off, np.zeros(len(other.points_mm), bool)])
    return _tree_to(whole, ends, doubted)


def _tree_to(net: Net, ends: Array, doubted: Array) -> Tree:
    """Return the shortest ways from the widest end of each part, as a tree.

    Those to (n,) bool ends, and what more of them is longer than a stub and not (n,) bool doubted,
    which counts as farther.
    """
    size = len(net.points_mm)
    one, other = net.steps.T
    length = (net.lengths_mm(net.steps) + 1e-6) * np.where(
        doubted[net.steps].any(axis=1), DOUBTED_LENGTH, 1.0
    )
    graph = sparse.csr_matrix((length, (one, other)), shape=(size, size))
    label = csgraph.connected_components(graph, directed=False)[1]
    some = np.bincount(net.steps.ravel(), minlength=size) > 0
    steps: set[tuple[int, int]] = set()
    for part in np.unique(label[some]):
        own = np.flatnonzero((label == part) & some)
        asked = own[ends[own]]
        likely = asked if len(asked) else own
        root = int(likely[net.radius_mm[likely].argmax()])
        far, before = csgraph.dijkstra(
            graph, directed=False, indices=root, return_predecessors=True
        )
        sure = own[~doubted[own]]
        leads = np.bincount(before[sure][before[sure] >= 0], minlength=size) > 0
        last = sure[~leads[sure] & ~ends[sure]]
        for end in (*asked, *last[np.argsort(-far[last], kind="stable")]):
            way = _way(before, int(end), root, steps)
            added = net.lengths_mm(np.array(way, np.int64).reshape(-1, 2)).sum()
            if ends[end] or added >= STUB_MM:
                steps.update(way)
    return _drawn(net, sorted(steps))


def _way(before: Array, end: int, root: int, steps: set[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the steps from an end back to the root, or to the first of those there already."""
    way, at = [], end
    while at != root:
        step = (min(at, int(before[at])), max(at, int(before[at])))
        if step in steps:
            break
        way.append(step)
        at = int(before[at])
    return way


def _drawn(net: Net, steps: list[tuple[int, int]]) -> Tree:
    """Return the tree of steps that make no loop."""
    near: dict[int, list[int]] = {}
    for a, b in steps:
        near.setdefault(a, []).append(b)
        near.setdefault(b, []).append(a)
    nodes = {point: k for k, point in enumerate(sorted(p for p in near if len(near[p]) != 2))}
    branches = []
    for node in nodes:
        for first in near[node]:
            way = [node, first]
            while way[-1] not in nodes:
                way.append(next(p for p in near[way[-1]] if p != way[-2]))
            if way[0] < way[-1]:
                branches.append(_branch(net, way, nodes[way[0]], nodes[way[-1]]))
    if not branches:
        return empty_tree()
    return Tree(nodes_mm=net.points_mm[list(nodes)], branches=tuple(branches))


def _branch(net: Net, way: list[int], start: int, end: int) -> Branch:
    points = net.points_mm[way]
    line = resample(points, NEW_STEP_MM)
    # Between two points, not from the nearer one: half-way, rounding would choose it.
    arc = polyline_arc(points)
    at = np.linspace(0.0, arc[-1], len(line))
    radius, confidence = (np.interp(at, arc, v[way]) for v in (net.radius_mm, net.confidence))
    return Branch(
        points_mm=line,
        radius_mm=np.maximum(radius, MIN_RADIUS_MM),
        sigma_mm=np.full(len(line), np.nan),
        confidence=confidence,
        start=start,
        end=end,
    )
