"""Ends of branches that lie on other tubes in every view."""

import numpy as np
import pytest

from gcar_deploy.tree.edit import with_branch
from gcar_deploy.tree.tree import Branch, Tree, empty_tree
from gcar_deploy.tubes.needed import needed_tree
from tests.tubes.scenes import carm, two_views

TRUNK = np.stack([np.arange(-40.0, 41.0), np.zeros(81), np.zeros(81)], axis=1)


def tree_of(*lines, radius=1.2):
    tree = empty_tree()
    for line in lines:
        tree = with_branch(tree, np.asarray(line, float), radius, 0.5, 1.5)
    return tree


def length_mm(tree):
    return sum(branch.length_mm for branch in tree.branches)


def beside(off_mm, start=-10.0, length=12.0):
    """A line that leaves the trunk and runs along it, so far off."""
    x = np.arange(start, start + length)
    y = np.minimum(off_mm, 0.5 * (x - start))
    return np.stack([x, y, 0.0 * x], axis=1)


def test_a_stub_that_runs_within_the_trunk_goes():
    whole = tree_of(TRUNK, beside(0.6))
    left = needed_tree(whole, two_views())
    assert len(whole.branches) == 3 and len(left.branches) == 1
    assert length_mm(left) == pytest.approx(80.0, abs=0.1)


@pytest.mark.parametrize("off_mm", [3.0, 8.0])
def test_a_branch_that_is_seen_by_itself_stays(off_mm):
    whole = tree_of(TRUNK, beside(off_mm, length=30.0))
    assert needed_tree(whole, two_views()) is whole


@pytest.mark.parametrize("hiding", [0, 1])
def test_a_branch_that_one_view_hides_behind_another_stays(hiding):
    views = two_views()
    ray = views[hiding].source_mm / np.linalg.norm(views[hiding].source_mm)
    # Away from the trunk along the rays of one view, where it stays on the trunk.
    x = np.arange(-10.0, 20.0)
    whole = tree_of(TRUNK, np.stack([x, 0 * x, 0 * x], axis=1) + np.outer(x + 10.0, ray))
    assert needed_tree(whole, views) is whole
    assert len(needed_tree(whole, [views[hiding]]).branches) == 1


def test_of_two_that_lie_on_each_other_one_stays():
    fork = np.stack([np.zeros(30), np.arange(30.0), np.zeros(30)], axis=1)
    double = fork + np.array([0.5, 0.0, 0.0])
    left = needed_tree(tree_of(TRUNK, fork, double[:26]), [*two_views(), carm(0, 30)])
    assert length_mm(left) == pytest.approx(80.0 + 29.0, abs=1.0)


def test_a_tree_of_one_branch_stays():
    whole = tree_of(TRUNK)
    assert needed_tree(whole, two_views()) is whole


def test_what_hangs_on_the_tree_at_both_ends_stays():
    ring = [TRUNK[20:61], TRUNK[20:61] + np.array([0.0, 0.3, 0.0])]
    lines = [TRUNK[:21], TRUNK[60:], *ring]
    ends = [(0, 1), (2, 3), (1, 2), (1, 2)]
    branches = [
        Branch(
            points_mm=line, radius_mm=np.full(len(line), 1.2), sigma_mm=np.full(len(line), np.nan),
            confidence=np.full(len(line), 0.5), start=start, end=end,
        )
        for line, (start, end) in zip(lines, ends, strict=True)
    ]  # fmt: skip
    whole = Tree(nodes_mm=TRUNK[[0, 20, 60, 80]], branches=tuple(branches))
    assert needed_tree(whole, two_views()) is whole
