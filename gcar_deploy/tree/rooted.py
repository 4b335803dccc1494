"""Run every branch from its inlet to its end, and number branches and nodes from there."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from gcar_deploy.tree.edit import reversed_branch
from gcar_deploy.tree.tree import Branch, Tree
from gcar_deploy.types import Scalars

#: lengths are no shorter than this, so that a sparse matrix keeps them as edges, mm
_LEAST_MM = 1e-9


def rooted(tree: Tree, inlets: Sequence[int]) -> Tree:
    """Turn and number the branches of a tree.

    Components stand in the order of their length, the longest first. In each, the branches that
    lead furthest come first at every fork: 1 is the one at the inlet, and numbers rise along the
    longest way, then along what leaves it, the last fork first. A branch's number is above that
    of the branch it leaves.

    Parameters
    ----------
    tree : Tree; where it has a loop, a branch begins at the end that is nearer to the inlet
    inlets : one node of each component

    Returns
    -------
    Tree with the same points; nodes are numbered as the branches meet them

    Raises
    ------
    ValueError
        A component has no inlet.
    """
    if not tree.branches:
        return tree
    far = _distance_mm(tree, inlets)
    branches = [reversed_branch(b) if far[b.start] > far[b.end] else b for b in tree.branches]
    if not all(np.isfinite(far[branch.start]) for branch in branches):
        raise ValueError("a component of the tree has no inlet")
    component = tree.components()
    length = np.zeros(len(tree.nodes_mm))
    for branch in branches:
        length[component[branch.start]] += branch.length_mm
    leaving = _leaving(branches, far)
    order: list[int] = []
    for inlet in sorted(inlets, key=lambda node: (-length[component[node]], node)):
        order += _preorder(inlet, branches, leaving)
    met = dict.fromkeys(n for k in order for n in (branches[k].start, branches[k].end))
    number = {node: k for k, node in enumerate(met)}
    return Tree(
        nodes_mm=tree.nodes_mm[list(met)],
        branches=tuple(
            dataclasses.replace(
                branches[k], start=number[branches[k].start], end=number[branches[k].end]
            )
            for k in order
        ),
    )


def inlet_arcs(tree: Tree) -> list[float | None]:
    """Distance of each branch's inlet from the ostium, mm; parents have lower numbers.

    The ostium is the first branch's. None for parts that do not hang on it: how far they are from
    it, nobody knows.
    """
    far: dict[int, float] = {tree.branches[0].start: 0.0} if tree.branches else {}
    out = []
    for branch in tree.branches:
        start = far.get(branch.start)
        out.append(start)
        if start is not None:
            far.setdefault(branch.end, start + branch.length_mm)
    return out


def _distance_mm(tree: Tree, inlets: Sequence[int]) -> Scalars:
    """(k,) way from each node to the nearest inlet, mm; infinite where there is none."""
    shortest: dict[tuple[int, int], float] = {}
    for branch in tree.branches:
        key = (min(branch.start, branch.end), max(branch.start, branch.end))
        shortest[key] = max(min(branch.length_mm, shortest.get(key, np.inf)), _LEAST_MM)
    n = len(tree.nodes_mm)
    ends = np.array(list(shortest), dtype=np.int64).reshape(-1, 2)
    steps = sparse.csr_matrix((list(shortest.values()), (ends[:, 0], ends[:, 1])), shape=(n, n))
    out: Scalars = csgraph.dijkstra(steps, directed=False, indices=list(inlets), min_only=True)
    return out


def _leaving(branches: Sequence[Branch], far: Scalars) -> dict[int, list[int]]:
    """Node to the branches that begin there, those that lead furthest first."""
    reach = far.copy()
    # From the far ends inwards, so that what lies beyond a branch is known before the branch.
    for k in sorted(range(len(branches)), key=lambda k: -far[branches[k].start]):
        branch = branches[k]
        reach[branch.start] = max(reach[branch.start], reach[branch.end])
    out: dict[int, list[int]] = {}
    for k, branch in enumerate(branches):
        out.setdefault(branch.start, []).append(k)
    for own in out.values():
        own.sort(key=lambda k: (-reach[branches[k].end], -branches[k].radius_mm.mean(), k))
    return out


def _preorder(inlet: int, branches: Sequence[Branch], leaving: dict[int, list[int]]) -> list[int]:
    """Branches of one component: each before all that leave its end."""
    out: list[int] = []
    visited = {inlet}
    waiting = leaving.get(inlet, [])[::-1]
    while waiting:
        k = waiting.pop()
        out.append(k)
        end = branches[k].end
        if end not in visited:
            visited.add(end)
            waiting += leaving.get(end, [])[::-1]
    return out
