"""Branches turned and numbered from their inlet."""

import dataclasses

import numpy as np
import pytest

from gcar_deploy.tree.edit import reversed_branch
from gcar_deploy.tree.rooted import rooted
from gcar_deploy.tree.tree import Tree, empty_tree
from tests.tree.shapes import branch, fork


def shuffled(tree, seed):
    """The same tree with its branches turned, its branches and nodes in another order."""
    rng = np.random.default_rng(seed)
    place = rng.permutation(len(tree.nodes_mm))
    turned = []
    for k in rng.permutation(len(tree.branches)):
        b = tree.branches[k]
        b = dataclasses.replace(b, start=int(place[b.start]), end=int(place[b.end]))
        turned.append(reversed_branch(b) if rng.random() < 0.5 else b)
    nodes = np.empty_like(tree.nodes_mm)
    nodes[place] = tree.nodes_mm
    return Tree(nodes_mm=nodes, branches=tuple(turned)), place


def line(a, b, start, end, radius=1.0):
    return branch(np.linspace(a, b, 11), radius, start, end)


def comb():
    """A trunk of 40 mm with twigs of 5 and 12 mm; the longest way is the trunk."""
    nodes = np.array([[0, 0, 0], [10, 0, 0], [20, 0, 0], [40, 0, 0], [10, 5, 0], [20, 12, 0.0]])
    pairs = [(0, 1), (1, 2), (2, 3), (2, 5), (1, 4)]
    return Tree(nodes_mm=nodes, branches=tuple(line(nodes[a], nodes[b], a, b) for a, b in pairs))


@pytest.mark.parametrize("seed", range(6))
def test_any_order_and_direction_gives_one_tree(seed):
    tree, place = shuffled(comb(), seed)
    out = rooted(tree, [int(place[0])])
    # Nodes are numbered as they are met: along the longest way, then the last fork first.
    assert [(b.start, b.end) for b in out.branches] == [(0, 1), (1, 2), (2, 3), (2, 4), (1, 5)]
    for made, true in zip(out.branches, comb().branches, strict=True):
        np.testing.assert_array_equal(made.points_mm, true.points_mm)
        np.testing.assert_array_equal(made.points_mm[0], out.nodes_mm[made.start])
        np.testing.assert_array_equal(made.points_mm[-1], out.nodes_mm[made.end])


def test_every_value_of_a_point_turns_with_it():
    first, *rest = fork().branches
    marked = dataclasses.replace(
        first, radius_mm=np.arange(25.0) + 1, sigma_mm=np.arange(25.0), confidence=np.arange(25.0)
    )
    tree = Tree(nodes_mm=fork().nodes_mm, branches=(marked, *rest))
    out = rooted(tree, [2])
    (found,) = (b for b in out.branches if b.radius_mm.max() > 20)
    np.testing.assert_array_equal(found.radius_mm, np.arange(25.0)[::-1] + 1)
    np.testing.assert_array_equal(found.sigma_mm, np.arange(25.0)[::-1])
    np.testing.assert_array_equal(found.confidence, np.arange(25.0)[::-1])
    np.testing.assert_array_equal(found.points_mm, marked.points_mm[::-1])
    assert [b.start for b in out.branches] == [0, 1, 1]


def test_components_stand_by_length_each_with_its_inlet():
    a = comb()
    b = Tree(nodes_mm=a.nodes_mm * 0.5 + 100, branches=tuple(
        dataclasses.replace(x, points_mm=x.points_mm * 0.5 + 100, start=x.start + 6, end=x.end + 6)
        for x in a.branches))  # fmt: skip
    both = Tree(nodes_mm=np.concatenate([a.nodes_mm, b.nodes_mm]), branches=b.branches + a.branches)
    out = rooted(both, [9, 0])
    assert out.branches[0].points_mm[0].tolist() == [0, 0, 0]
    assert out.branches[5].points_mm[0].tolist() == [120, 100, 100]
    assert out.components().tolist() == [0] * 6 + [1] * 6
    with pytest.raises(ValueError, match="no inlet"):
        rooted(both, [0])


def test_a_loop_runs_away_from_the_inlet_on_both_sides():
    """A ring of 10 and 30 mm between two nodes, with a trunk and a tail."""
    nodes = np.array([[0, 0, 0], [10, 0, 0], [20, 0, 0], [35, 0, 0.0]])
    round_ = np.array([[20, 0, 0], [15, 14, 0], [10, 0, 0.0]])
    tree = Tree(nodes_mm=nodes, branches=(
        branch(round_, 1.0, 2, 1), line(nodes[2], nodes[1], 2, 1),
        line(nodes[0], nodes[1], 0, 1), line(nodes[3], nodes[2], 3, 2)))  # fmt: skip
    out = rooted(tree, [0])
    assert len(out.branches) == 4 and out.branches[0].end == 1
    # Each begins nearer to the inlet than it ends: at the trunk's end, and at the ring's far side.
    assert sorted((b.start, b.end) for b in out.branches) == [(0, 1), (1, 2), (1, 2), (2, 3)]


def test_a_closed_ring_and_nothing_at_all():
    ring = branch([[0, 0, 0], [4, 4, 0], [8, 0, 0], [4, -4, 0], [0, 0, 0.0]], 1.0, 0, 0)
    out = rooted(Tree(nodes_mm=np.zeros((1, 3)), branches=(ring,)), [0])
    np.testing.assert_array_equal(out.branches[0].points_mm, ring.points_mm)
    assert rooted(empty_tree(), []).branches == ()
