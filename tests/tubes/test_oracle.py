"""The oracle against closed forms, and the tube model against the oracle."""

import numpy as np
import pytest

from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.model import footprint, tubes_of
from tests.hard.phantoms import PAIR, seven
from tests.tree.shapes import branch, fork, tube
from tests.tubes.oracle import path_lengths
from tests.tubes.scenes import carm, two_views


def test_a_ball_has_the_chords_of_a_sphere():
    middle, radius = np.array([4.0, -7.0, 9.0]), 6.0
    line = middle + np.array([[0, 0, -1e-9], [0, 0, 1e-9]])
    view = carm(30, -20, size=96, spacing=1.2)
    image = path_lengths(Tree(nodes_mm=line, branches=(branch(line, radius),)), view, rays=1)
    pixels = np.stack(np.meshgrid(np.arange(96), np.arange(96)), -1).reshape(-1, 2)
    beside = np.linalg.norm(np.cross(view.rays(pixels), middle - view.source_mm), axis=1)
    chord = 2 * np.sqrt(np.maximum(radius**2 - beside**2, 0))
    np.testing.assert_allclose(image.ravel(), chord, atol=1e-5)


@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 1, 0.3), (0.2, -1, 0.6)])
def test_all_paths_together_are_the_volume(axis):
    view = carm(20, 15)
    area = (0.5 * view.sod_mm / view.sdd_mm) ** 2
    volume = np.pi * 1.4**2 * 40 + 4 / 3 * np.pi * 1.4**3
    image = path_lengths(tube(length=40, radius=1.4, count=51, axis=axis), view)
    assert image.sum() * area == pytest.approx(volume, rel=0.02)


def test_vessels_in_one_place_count_once_and_behind_each_other_twice():
    view, one = carm(0, 0), tube()
    behind = branch(one.branches[0].points_mm + np.array([0, 20.0, 0]), 1.5, 2, 3)
    nodes = np.concatenate([one.nodes_mm, behind.points_mm[[0, -1]]])
    alone = path_lengths(one, view)
    same = path_lengths(Tree(nodes_mm=one.nodes_mm, branches=one.branches * 2), view)
    both = path_lengths(Tree(nodes_mm=nodes, branches=(*one.branches, behind)), view)
    np.testing.assert_allclose(same, alone, atol=1e-5)
    assert alone.max() == pytest.approx(3.0, rel=0.02) and both.max() > 5.8


@pytest.mark.slow
@pytest.mark.parametrize("tree", [fork(), seven()], ids=["fork", "seven"])
@pytest.mark.parametrize("views", [two_views(), PAIR], ids=["fine", "coarse"])
def test_the_model_shows_what_the_oracle_shows(tree, views):
    """But where a vessel bends behind another, and within half a pixel of an edge."""
    for view in views:
        truth = path_lengths(tree, view, rays=4)
        model = footprint(tubes_of(tree), view, 1.0).image((view.rows, view.columns))
        off = np.abs(model - truth)[(truth > 0) | (model > 0)]
        assert np.median(off) < 0.02
        assert np.percentile(off, 95) < 0.3
        assert model.sum() == pytest.approx(truth.sum(), rel=0.03)
