"""Trees of ways through the pairs of two views' lines."""

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.tubes.line_pairs import line_pairs
from gcar_deploy.tubes.ways import Trust, tree_of_ways
from tests.tree.shapes import fork
from tests.tubes.scenes import seen_as_masks, two_views

TRUST = Trust(5.0, 1.0)


def _pairs(tree):
    return line_pairs(seen_as_masks(tree, two_views()))


def test_ways_make_the_tree_that_both_pictures_show():
    truth = fork()
    pairs = _pairs(truth)
    found = tree_of_ways(pairs, np.full(len(pairs), 0.5), TRUST)
    # Both rays of a pair may miss each other by the planes' distance, which depth feels twice.
    assert cKDTree(truth.points()).query(found.points())[0].max() < 2.5
    # A mask's skeleton ends a radius before the vessel does.
    assert np.quantile(cKDTree(found.points()).query(truth.points())[0], 0.95) < 2.0
    assert found.parts().max() == 0
    assert sorted(found.degrees)[-1] == 3


def test_a_way_that_costs_more_than_it_explains_is_none():
    pairs = _pairs(fork())
    assert not tree_of_ways(pairs, np.zeros(len(pairs)), Trust(1e4, 0.0)).branches


def test_what_the_predictor_believes_decides_between_ways():
    truth = fork()
    pairs = _pairs(truth)
    near = cKDTree(truth.points()).query(pairs.points_mm)[0] < 1.0
    right = tree_of_ways(pairs, np.where(near, 0.9, 0.0), TRUST)
    wrong = tree_of_ways(pairs, np.where(near, 0.0, 0.9), Trust(50.0, 0.0))
    far = [cKDTree(truth.points()).query(one.points())[0] for one in (right, wrong)]
    assert far[0].max() < 2.5
    assert not len(far[1]) or far[1].max() > far[0].max()


def test_radii_come_from_the_narrower_line():
    truth = fork()
    pairs = _pairs(truth)
    found = tree_of_ways(pairs, np.full(len(pairs), 0.5), TRUST)
    _, nearest = cKDTree(truth.points()).query(found.points())
    ratio = found.radii() / truth.radii()[nearest]
    assert 0.6 < np.median(ratio) < 1.3
