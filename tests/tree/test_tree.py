import numpy as np

from gcar_deploy.tree.edit import kept_branches, merged, reversed_branch
from gcar_deploy.tree.tree import Tree, empty_tree
from tests.tree.shapes import branch, fork, tube


def test_lengths_and_flat_views():
    tree = tube(length=30.0, count=31)
    assert tree.length_mm == np.float64(30.0)
    assert tree.points().shape == (31, 3)
    starts, ends, r0, r1 = tree.segments()
    assert len(starts) == len(ends) == len(r0) == len(r1) == 30
    np.testing.assert_allclose(tree.branches[0].tangents, np.tile([0, 0, 1.0], (31, 1)))


def test_empty_tree_has_empty_arrays():
    tree = empty_tree()
    assert tree.points().shape == (0, 3)
    assert tree.segments()[0].shape == (0, 3)
    assert tree.length_mm == 0


def test_degrees_and_components():
    tree = fork()
    np.testing.assert_array_equal(tree.degrees, [1, 3, 1, 1])
    apart = Tree(
        nodes_mm=np.array([[0, 0, 0], [1, 0, 0], [5, 0, 0], [6.0, 0, 0]]),
        branches=(branch([[0, 0, 0], [1, 0, 0]], 1, 0, 1), branch([[5, 0, 0], [6, 0, 0]], 1, 2, 3)),
    )
    np.testing.assert_array_equal(apart.components(), [0, 0, 1, 1])


def test_dropping_a_daughter_joins_what_no_longer_forks():
    tree = fork()
    left = kept_branches(tree, np.array([True, True, False]))
    assert len(left.branches) == 1
    assert len(left.branches[0]) == len(tree.branches[0]) + len(tree.branches[1]) - 1
    np.testing.assert_allclose(left.length_mm, sum(b.length_mm for b in tree.branches[:2]))
    np.testing.assert_array_equal(left.degrees, [1, 1])


def test_merging_respects_direction():
    tree = fork()
    turned = Tree(
        nodes_mm=tree.nodes_mm,
        branches=(reversed_branch(tree.branches[0]), reversed_branch(tree.branches[1])),
    )
    joined = merged(turned)
    assert len(joined.branches) == 1
    steps = np.linalg.norm(np.diff(joined.branches[0].points_mm, axis=0), axis=1)
    assert steps.max() < 2.0


def test_a_closed_ring_survives_merging():
    ring = Tree(
        nodes_mm=np.array([[0, 0, 0.0], [1, 0, 0]]),
        branches=(
            branch([[0, 0, 0], [0.5, 1, 0], [1, 0, 0]], 0.3, 0, 1),
            branch([[1, 0, 0], [0.5, -1, 0], [0, 0, 0]], 0.3, 1, 0),
        ),
    )
    assert merged(ring).length_mm > 3
