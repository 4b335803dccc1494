"""Change a tree's topology: drop branches, cut and lengthen ends, merge what no longer forks."""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.tree.curves import resample
from gcar_deploy.tree.tree import Branch, Tree
from gcar_deploy.types import Array, Points

#: what every point of a branch has, whatever is known of it
_PER_POINT = ("points_mm", "radius_mm", "sigma_mm", "confidence")
#: points of a new branch are so far apart, mm
NEW_STEP_MM = 1.0
#: confidence of points that no predictor told of
UNTOLD = 0.1


def kept_branches(tree: Tree, keep: Array) -> Tree:
    """Keep some branches, (b,) bool; nodes with two ends left become inner points."""
    branches = tuple(b for b, k in zip(tree.branches, keep, strict=True) if k)
    return merged(dataclasses.replace(tree, branches=branches))


def without_branch_at(tree: Tree, place_mm: Array, within_mm: float) -> Tree | None:
    """Drop the branch that passes nearest to a place; None where none passes near enough.

    Parameters
    ----------
    tree : Tree
    place_mm : (3,) in the tree's coordinates
    within_mm : most distance from a branch's centreline, or its radius where that is more

    Returns
    -------
    Tree, joined where two branches are left at a node, or None
    """
    nearest = _nearest(tree, place_mm)
    if nearest is None:
        return None
    number, at, gap = nearest
    if gap > max(within_mm, float(tree.branches[number].radius_mm[at])):
        return None
    return kept_branches(tree, np.arange(len(tree.branches)) != number)


def merged(tree: Tree) -> Tree:
    """Join branches that meet two at a node, and renumber the nodes that are left."""
    branches = list(tree.branches)
    ends: dict[int, list[int]] = {}
    for i, branch in enumerate(branches):
        ends.setdefault(branch.start, []).append(i)
        ends.setdefault(branch.end, []).append(i)
    alive = [True] * len(branches)
    for node in sorted(ends):
        pair = ends[node]
        if len(pair) != 2 or pair[0] == pair[1]:
            continue
        i, j = sorted(pair)
        first, second = branches[i], branches[j]
        first = first if first.end == node else reversed_branch(first)
        second = second if second.start == node else reversed_branch(second)
        branches[i] = _concatenated(first, second)
        alive[j] = False
        far = second.end
        ends[far] = [i if k == j else k for k in ends[far]]
        ends[node] = []
    left = [b for b, a in zip(branches, alive, strict=True) if a]
    used = sorted({n for b in left for n in (b.start, b.end)})
    number = {n: k for k, n in enumerate(used)}
    left = [dataclasses.replace(b, start=number[b.start], end=number[b.end]) for b in left]
    nodes = tree.nodes_mm[np.array(used, dtype=np.int64)] if used else np.zeros((0, 3))
    return Tree(nodes_mm=nodes, branches=tuple(left))


def with_branch(
    tree: Tree, points_mm: Points, radius_mm: float, confidence: float, within_mm: float
) -> Tree:
    """Add a branch; where it begins near the tree it is joined to it.

    Parameters
    ----------
    tree : Tree
    points_mm : (m, 3) places along the new branch, m >= 2; it is drawn in steps of some mm
    radius_mm, confidence : of all its points
    within_mm : most distance of its first place from a centreline that it leaves

    Returns
    -------
    Tree
        The branch that is left is cut in two there, unless it ends there.
    """
    nearest = _nearest(tree, points_mm[0])
    if nearest is not None and nearest[2] <= within_mm:
        tree, start = parted(tree, *nearest[:2])
        nodes = list(tree.nodes_mm)
        # The first place gives way to the node, so that no step is next to nothing.
        points_mm = np.concatenate([nodes[start][None], points_mm[1:]])
    else:
        start, nodes = len(tree.nodes_mm), [*tree.nodes_mm, points_mm[0]]
    line = resample(points_mm, NEW_STEP_MM)
    same = np.ones(len(line))
    new = Branch(
        points_mm=line, radius_mm=radius_mm * same, sigma_mm=np.nan * same,
        confidence=confidence * same, start=start, end=len(nodes),
    )  # fmt: skip
    nodes.append(line[-1])
    return merged(Tree(nodes_mm=np.array(nodes), branches=(*tree.branches, new)))


def parted(tree: Tree, number: int, at: int) -> tuple[Tree, int]:
    """Return the tree with a node at a branch's point, and that node's number.

    What lies behind the point becomes the last branch; nothing changes where a node is there.
    """
    branch, node = tree.branches[number], len(tree.nodes_mm)
    if at in (0, len(branch) - 1):
        return tree, branch.end if at else branch.start
    branches = list(tree.branches)
    branches[number] = dataclasses.replace(part_of(branch, 0, at), end=node)
    branches.append(dataclasses.replace(part_of(branch, at, len(branch) - 1), start=node))
    nodes = np.concatenate([tree.nodes_mm, branch.points_mm[[at]]])
    return Tree(nodes_mm=nodes, branches=tuple(branches)), node


def reversed_branch(branch: Branch) -> Branch:
    """Return the branch run the other way."""
    turned = _points_of(branch, slice(None, None, -1))
    return dataclasses.replace(turned, start=branch.end, end=branch.start)


def part_of(branch: Branch, first: int, last: int) -> Branch:
    """Points ``first`` to ``last`` (inclusive) of a branch; its node numbers are kept."""
    return _points_of(branch, slice(first, last + 1))


def with_ends_moved(tree: Tree) -> Tree:
    """Set each free end's node to where its branch ends now."""
    nodes = tree.nodes_mm.copy()
    degrees = tree.degrees
    for branch in tree.branches:
        for node, point in (
            (branch.start, branch.points_mm[0]),
            (branch.end, branch.points_mm[-1]),
        ):
            if degrees[node] == 1:
                nodes[node] = point
    return dataclasses.replace(tree, nodes_mm=nodes)


def _nearest(tree: Tree, place_mm: Array) -> tuple[int, int, float] | None:
    """Branch that passes nearest to a (3,) place, its point there, and the gap."""
    gaps = [np.linalg.norm(branch.points_mm - place_mm, axis=1) for branch in tree.branches]
    if not gaps:
        return None
    number = int(np.argmin([gap.min() for gap in gaps]))
    at = int(gaps[number].argmin())
    return number, at, float(gaps[number][at])


def _points_of(branch: Branch, cut: slice) -> Branch:
    known = branch.covariance_mm2
    return dataclasses.replace(
        branch,
        **{name: getattr(branch, name)[cut] for name in _PER_POINT},
        covariance_mm2=None if known is None else known[cut],
    )


def _concatenated(first: Branch, second: Branch) -> Branch:
    parts = {
        name: np.concatenate([getattr(first, name), getattr(second, name)[1:]])
        for name in _PER_POINT
    }
    both = None
    if first.covariance_mm2 is not None and second.covariance_mm2 is not None:
        both = np.concatenate([first.covariance_mm2, second.covariance_mm2[1:]])
    return Branch(**parts, start=first.start, end=second.end, covariance_mm2=both)
