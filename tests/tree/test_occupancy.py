import numpy as np
import pytest

from gcar_deploy.geometry.grid import Grid
from gcar_deploy.tree import occupancy
from gcar_deploy.tree.occupancy import near_pairs, sparse_occupancy, tree_occupancy
from gcar_deploy.tree.tree import Tree, empty_tree
from tests.tree.shapes import branch, fork, grid, tube


def slow_occupancy(tree, where, samples=8):
    """Count sub-samples inside any capsule: the obvious, slow way."""
    step = (np.arange(samples) + 0.5) / samples - 0.5
    offsets = np.stack(np.meshgrid(step, step, step, indexing="ij"), -1).reshape(-1, 3)
    index = np.stack(np.unravel_index(np.arange(np.prod(where.shape)), where.shape), 1)
    total = np.zeros(len(index))
    a, b, ra, rb = tree.segments()
    for offset in offsets:
        points = where.index2world(index + offset)
        inside = np.zeros(len(points), bool)
        for k in range(len(a)):
            axis = b[k] - a[k]
            t = np.clip((points - a[k]) @ axis / (axis @ axis), 0, 1)
            far = np.linalg.norm(points - a[k] - t[:, None] * axis, axis=1)
            inside |= far < ra[k] + t * (rb[k] - ra[k])
        total += inside
    return (total / len(offsets)).reshape(where.shape)


@pytest.mark.parametrize("radius", [0.4, 0.8, 1.7, 3.2])
def test_matches_the_slow_twin(radius):
    where = grid(16)
    tree = Tree(
        nodes_mm=np.array([[-4.0, -3, -5], [4, 3.3, 5]]),
        branches=(
            branch([[-4, -3, -5], [0.3, 0.1, 0], [4, 3.3, 5]], [radius, radius, radius / 2]),
        ),
    )
    fast, slow = tree_occupancy(tree, where), slow_occupancy(tree, where)
    assert np.abs(fast - slow).max() < 0.09
    assert np.sqrt(np.mean((fast - slow)[(slow > 0) & (slow < 1)] ** 2)) < 0.02
    assert abs(fast.sum() / slow.sum() - 1) < 0.015


def test_volume_of_a_tube():
    tree = tube(length=30, radius=2)
    expected = np.pi * 4 * 30 + 4 / 3 * np.pi * 8
    assert tree_occupancy(tree, grid(64)).sum() == pytest.approx(expected, rel=0.01)


def test_voxels_far_wider_than_the_vessel_hold_as_much_of_it():
    for shape in ((1, 1, 1), (3, 2, 5), (64, 2, 1)):
        where = Grid(center_mm=(0, 0, 0), size_mm=(64.0,) * 3, shape=shape)
        volume = tree_occupancy(tube(length=30, radius=2), where)
        expected = np.pi * 4 * 30 + 4 / 3 * np.pi * 8
        assert volume.shape == shape
        assert volume.sum() * np.prod(where.spacing_mm) == pytest.approx(expected, rel=0.03)


def test_joined_branches_are_a_union():
    volume = tree_occupancy(fork(), grid(64))
    assert volume.max() == 1.0
    assert volume.min() == 0.0


def test_oblong_voxels_and_tubes_outside():
    where = Grid(center_mm=(0, 0, 0), size_mm=(40, 20, 30), shape=(40, 10, 60))
    volume = tree_occupancy(tube(length=100, radius=2), where)
    assert volume.sum() * np.prod(where.spacing_mm) == pytest.approx(np.pi * 4 * 30, rel=0.02)
    away = Grid(center_mm=(500, 0, 0), size_mm=(10, 10, 10), shape=(10, 10, 10))
    assert not tree_occupancy(tube(), away).any()


def test_empty_tree():
    assert not tree_occupancy(empty_tree(), grid(8)).any()
    assert len(sparse_occupancy(empty_tree(), grid(8))[0]) == 0


@pytest.mark.parametrize("most", [1, 1000, 200_000])
def test_pairs_are_those_of_all_voxels_and_capsules(monkeypatch, most):
    monkeypatch.setattr(occupancy, "CHUNK", most)
    # Oblong voxels; one capsule reaches out of the grid, one is a point, one lies outside.
    where = Grid(center_mm=(1, -2, 3), size_mm=(24, 15, 22), shape=(20, 15, 11))
    a = np.array([[-4.0, -3, -5], [4, 3.3, 5], [9, 0, 9], [2, -3, 4], [80, 0, 0]])
    b = np.array([[4.0, 3.3, 5], [4.2, 3.3, 5.9], [40, 8, 30], [2, -3, 4], [90, 0, 0]])
    ra, rb = np.array([0.4, 1.7, 3.0, 2.0, 1.0]), np.array([1.7, 0.8, 2.0, 2.0, 1.0])
    index = np.stack(np.unravel_index(np.arange(np.prod(where.shape)), where.shape), 1)
    points, expected = where.index2world(index), {}
    for k in range(len(a)):
        axis = b[k] - a[k]
        t = np.clip((points - a[k]) @ axis / max(axis @ axis, 1e-18), 0, 1)
        far = np.linalg.norm(points - a[k] - t[:, None] * axis, axis=1)
        far -= ra[k] + t * (rb[k] - ra[k])
        expected |= {(v, k): far[v] for v in np.flatnonzero(far < 1.1)}
    voxel, capsule, distance = near_pairs((a, b, ra, rb), where, 1.1)
    found = dict(zip(zip(voxel.tolist(), capsule.tolist(), strict=True), distance, strict=True))
    assert found.keys() == expected.keys() and len(found) == len(voxel)
    assert [found[key] for key in expected] == pytest.approx(list(expected.values()), abs=1e-12)
