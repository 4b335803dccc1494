"""Trees of ways beside the tree that was found, and the best of all."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree
from skimage.morphology import skeletonize

from gcar_deploy.config import TubeOptions
from gcar_deploy.tree.edit import with_branch
from gcar_deploy.tree.tree import empty_tree
from gcar_deploy.tubes.gauss_newton import Progress
from gcar_deploy.tubes.proposal import Told
from gcar_deploy.tubes.relink import relinked, ways_beside
from gcar_deploy.tubes.run import Run
from gcar_deploy.tubes.targets import make_targets
from tests.tree.shapes import fork, grid, points_of
from tests.tubes.scenes import seen, seen_as_masks, two_views

OPTIONS = TubeOptions()


def _along_a_ray(view, by_mm):
    """The fork with the far half of a daughter shifted along the rays of a view: one line there."""
    truth = fork()
    ray = view.source_mm / np.linalg.norm(view.source_mm)
    wrong = empty_tree()
    for k, branch in enumerate(truth.branches):
        line = branch.points_mm
        if k == 1:
            off = by_mm * np.clip(np.linspace(-0.5, 1.5, len(line)), 0, 1)
            line = line + off[:, None] * ray
        wrong = with_branch(wrong, line, float(branch.radius_mm[0]), 1.0, 1.0)
    return truth, wrong


def _with_lines(views):
    return [dataclasses.replace(view, skeleton=skeletonize(view.mask)) for view in views]


def _tried(tree, views, believed, should_stop=None):
    run = Run(OPTIONS, Progress(), should_stop, points_of(believed, grid(64)))
    targets = make_targets(views, 0.0, OPTIONS)
    now = Run(OPTIONS, Progress(), None, run.evidence).tried(tree, targets)
    ways = ways_beside(now.tree, views, targets, Told.by(run.evidence))
    return now, relinked(now, ways, targets, run) if ways else now


@pytest.mark.parametrize("view", [0, 1])
def test_a_vessel_at_a_wrong_depth_comes_right_though_it_is_believed_in(view):
    carms = two_views()
    truth, wrong = _along_a_ray(carms[view], 9.0)
    now, found = _tried(wrong, seen_as_masks(truth, carms), wrong)
    assert found.loss < 0.8 * now.loss
    assert cKDTree(now.tree.points()).query(truth.points())[0].max() > 3.0
    assert cKDTree(found.tree.points()).query(truth.points())[0].max() < 2.5


def test_of_true_paths_a_vessel_at_a_wrong_depth_comes_right():
    carms = two_views()
    truth, wrong = _along_a_ray(carms[0], 9.0)
    now, found = _tried(wrong, _with_lines(seen(truth, carms, calibrated=True)), wrong)
    assert found.loss < 0.2 * now.loss
    assert cKDTree(found.tree.points()).query(truth.points())[0].max() < 2.5


def test_a_right_tree_stays_as_it_is():
    carms = two_views()
    now, found = _tried(fork(), seen_as_masks(fork(), carms), fork())
    assert found is now


def test_paths_that_are_estimates_say_too_little():
    carms = two_views()
    truth, wrong = _along_a_ray(carms[0], 9.0)
    now, found = _tried(wrong, _with_lines(seen(truth, carms, calibrated=False)), wrong)
    assert found is now


def test_more_than_two_views_are_not_paired():
    carms = [*two_views(), two_views()[0]]
    truth, wrong = _along_a_ray(carms[0], 9.0)
    now, found = _tried(wrong, seen_as_masks(truth, carms), wrong)
    assert found is now


def test_a_deadline_leaves_what_there_was():
    carms = two_views()
    truth, wrong = _along_a_ray(carms[0], 9.0)
    now, found = _tried(wrong, seen_as_masks(truth, carms), wrong, lambda: True)
    assert found is now
