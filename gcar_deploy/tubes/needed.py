"""Ends of branches that no view needs: the tree explains the pictures as well without them.

Where a vessel's points scatter, the tree grows stubs beside it; where wrongly paired lines end,
pieces of them stay behind. Such an end lies on other tubes in every view. A vessel that is there
lies on its own in one of them at least, for half of its way.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.tree.edit import kept_branches
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Scalars

#: a branch with a free end goes where each view shows this share of it on others; on generated
#: masks 0.5 took nearly as much vessel as it took ghosts
COVERED_SHARE = 0.8
#: a point lies on another tube that is so near in the view, or nearer than its radius, mm
LEAST_RADIUS_MM = 0.5


def needed_tree(tree: Tree, carms: Sequence[CArm]) -> Tree:
    """Drop the branches with a free end that lie on others in every view, the shortest first.

    Parameters
    ----------
    tree : Tree
    carms : of all views

    Returns
    -------
    Tree; the same one where every branch is needed
    """
    if len(tree.branches) < 2:
        return tree
    own, count = tree.branch_index(), len(tree.branches)
    points = np.bincount(own, minlength=count)
    pairs = [_covering(tree, own, carm) for carm in carms]
    ends = np.array([(branch.start, branch.end) for branch in tree.branches])
    length = np.array([branch.length_mm for branch in tree.branches])
    kept = np.ones(count, bool)
    while True:
        degrees = np.bincount(ends[kept].ravel(), minlength=len(tree.nodes_mm))
        share = np.ones(count)
        for point, by in pairs:
            covered = np.zeros(len(own), bool)
            covered[point[kept[by]]] = True
            share = np.minimum(share, np.bincount(own, covered, minlength=count) / points)
        free = kept & (degrees[ends] == 1).any(axis=1)
        # One after the other: of two that lie on each other one is needed.
        found = np.flatnonzero(free & (share >= COVERED_SHARE))
        if not len(found):
            return tree if kept.all() else kept_branches(tree, kept)
        kept[found[length[found].argmin()]] = False


def _covering(tree: Tree, own: Array, carm: CArm) -> tuple[Array, Array]:
    """Points that lie on another branch's tube in a view, and that branch, (k,) each."""
    pixels, depth = carm.project(tree.points())
    places = np.where(depth[:, None] > 1.0, pixels * carm.pixel_at_isocenter_mm, 1e6)
    radius: Scalars = np.maximum(tree.radii(), LEAST_RADIUS_MM)
    one = cKDTree(places).query_pairs(float(radius.max()), output_type="ndarray")
    both = np.concatenate([one, one[:, ::-1]])
    gap = np.linalg.norm(places[both[:, 0]] - places[both[:, 1]], axis=1)
    other = own[both[:, 0]] != own[both[:, 1]]
    point, by = both[other & (gap <= radius[both[:, 1]])].T
    return point, own[by]
