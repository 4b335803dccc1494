"""Tubes that are no coronary tree: within bounds, attached, of every sort, and trained on."""

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from gcar_export.scenes.free_tubes import REACH_MM, free_tubes
from gcar_export.training.dataset import training_scene
from gcar_export.training.examinations import SceneOptions


def _graph(tree):
    """(nodes, segments) of capsules that share ends."""
    ends = np.round(np.concatenate([tree.starts, tree.ends]), 6)
    places, number = np.unique(ends, axis=0, return_inverse=True)
    return len(places), number.reshape(2, -1)


def test_tubes_stay_within_their_bounds_and_are_drawn_again_alike():
    for seed in range(40):
        tree = free_tubes(np.random.default_rng(seed), 0.3)
        assert np.linalg.norm(tree.starts, axis=1).max() <= REACH_MM + 1e-6
        assert tree.radii.min() >= 0.3 and tree.radii.max() < 8
        np.testing.assert_array_equal(
            tree.starts, free_tubes(np.random.default_rng(seed), 0.3).starts
        )


@pytest.mark.slow
def test_there_are_forks_rings_and_trees_apart():
    parts, rings, forks = [], 0, 0
    for seed in range(120):
        n, (a, b) = _graph(free_tubes(np.random.default_rng(seed)))
        count, _ = connected_components(coo_matrix((np.ones(len(a)), (a, b)), (n, n)))
        parts.append(count)
        rings += len(a) - n + count > 0  # more edges than a forest has
        forks += np.bincount(np.concatenate([a, b])).max() > 2
    assert parts.count(1) > 60 and max(parts) > 2
    assert 3 < rings < 40
    assert forks > 80


def test_a_share_of_training_scenes_shows_them():
    exact = {"inputs": (1.0, 0.0, 0.0, 0.0), "paper_share": 0.0, "fine_share": 0.0}
    trees = training_scene(5, 0, SceneOptions(free_share=0.0, **exact))
    tubes = training_scene(5, 0, SceneOptions(free_share=1.0, **exact))
    assert len(trees.line_mm) != len(tubes.line_mm)
    # What the scene calls vessel holds its lines.
    shown = tubes.points_mm[tubes.occupancy >= 0.5]
    gap = np.linalg.norm(tubes.line_mm[:, None] - shown[None], axis=2).min(axis=1)
    assert np.quantile(gap, 0.9) < 1.5 * tubes.spacing_mm


@pytest.mark.parametrize("seed", range(3))
def test_coils_turn_steadily(seed):
    """A tube has no corners: neighbouring segments turn by less than 30 degrees."""
    tree = free_tubes(np.random.default_rng(seed))
    way = tree.ends - tree.starts
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    joined = np.abs(tree.ends[:-1] - tree.starts[1:]).max(axis=1) < 1e-9
    cosine = np.sum(way[:-1] * way[1:], axis=1)[joined]
    assert (cosine > np.cos(np.deg2rad(30))).all()
