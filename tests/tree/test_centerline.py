import numpy as np
import pytest
from scipy.spatial import cKDTree

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.tree.centerline import build_tree
from gcar_deploy.tree.curves import resample, smooth_line
from gcar_deploy.tree.occupancy import tree_occupancy
from gcar_deploy.tree.tree import Tree
from tests.tree.shapes import branch, dice, fork, grid, points_of, tube


def test_straight_tube_is_one_branch_of_its_length_and_radius():
    tree = build_tree(points_of(tube(length=30, radius=1.5), grid(48)))
    assert len(tree.branches) == 1
    assert tree.length_mm == pytest.approx(31.5, abs=2.5)
    middle = tree.branches[0].radius_mm[8:-8]
    np.testing.assert_allclose(middle, 1.5, atol=0.1)
    assert np.abs(tree.points()[5:-5, :2]).max() < 0.1


def test_fork_has_three_branches_and_one_bifurcation():
    truth = fork()
    where = grid(64)
    tree = build_tree(points_of(truth, where))
    assert len(tree.branches) == 3
    assert sorted(tree.degrees.tolist()) == [1, 1, 1, 3]
    node = tree.nodes_mm[np.argmax(tree.degrees)]
    assert np.linalg.norm(node) < 6.0
    assert dice(tree_occupancy(tree, where), tree_occupancy(truth, where)) > 0.93


@pytest.mark.parametrize("seed", range(3))
def test_noise_of_one_voxel_keeps_the_topology(seed):
    truth = fork()
    tree = build_tree(points_of(truth, grid(64), noise=0.7, seed=seed))
    off = cKDTree(truth.points()).query(tree.points())[0]
    assert np.median(off) < 0.8
    assert 0.8 < tree.length_mm / truth.length_mm < 1.4


def test_two_components_stay_two():
    a = tube(length=30)
    shift = np.array([15.0, 0, 0])
    both = Tree(
        nodes_mm=np.concatenate([a.nodes_mm, a.nodes_mm + shift]),
        branches=(a.branches[0], branch(a.branches[0].points_mm + shift, 1.5, 2, 3)),
    )
    tree = build_tree(points_of(both, grid(64)))
    assert len(np.unique(tree.components())) == 2


def test_short_gap_is_bridged_and_long_gap_is_not():
    centers = points_of(tube(length=40, radius=1.5), grid(64))
    z = centers.points_mm[:, 2]
    assert len(build_tree(centers.select(np.abs(z) > 2.0)).branches) == 1
    assert len(build_tree(centers.select(np.abs(z) > 7.0)).branches) == 2


def test_a_ring_is_opened():
    phi = np.linspace(0, 2 * np.pi, 60)
    line = 12 * np.stack([np.cos(phi), np.sin(phi), 0 * phi], 1)
    ring = Tree(nodes_mm=line[[0, -1]], branches=(branch(line, 1.5),))
    tree = build_tree(points_of(ring, grid(48)))
    nodes, branches = len(tree.nodes_mm), len(tree.branches)
    assert branches == nodes - len(np.unique(tree.components()))


def test_given_radius_is_used():
    centers = points_of(tube(length=30, radius=1.5), grid(48))
    told = CenterPoints(
        points_mm=centers.points_mm,
        confidence=centers.confidence,
        radius_mm=np.full(len(centers), 2.25),
        spacing_mm=1.0,
        source="multi",
    )
    np.testing.assert_allclose(build_tree(told).radii(), 2.25)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_points_give_an_empty_tree(count):
    rng = np.random.default_rng(0)
    centers = CenterPoints(
        points_mm=rng.normal(size=(count, 3)),
        confidence=np.ones(count),
        radius_mm=np.full(count, np.nan),
        spacing_mm=1.0,
        source="hull",
    )
    assert build_tree(centers).branches == ()


def test_points_that_are_not_finite_are_left_out():
    centers = points_of(tube(), grid(48))
    bad = centers.points_mm.copy()
    bad[::50] = np.nan
    tree = build_tree(
        CenterPoints(
            points_mm=bad,
            confidence=centers.confidence,
            radius_mm=centers.radius_mm,
            spacing_mm=1.0,
            source="multi",
        )
    )
    assert np.isfinite(tree.points()).all()
    assert tree.branches


def test_same_input_same_bytes():
    centers = points_of(fork(), grid(64), noise=0.5)
    a, b = build_tree(centers), build_tree(centers)
    assert a.points().tobytes() == b.points().tobytes()
    assert a.radii().tobytes() == b.radii().tobytes()


def test_resample_keeps_ends_and_smoothing_keeps_a_line():
    line = np.array([[0, 0, 0], [1, 0, 0], [5, 0, 0.0]])
    out = resample(line, 0.5)
    assert len(out) == 11
    np.testing.assert_allclose(out[[0, -1]], line[[0, -1]])
    np.testing.assert_allclose(smooth_line(out, np.ones(11), 2.0), out, atol=1e-12)
