"""Pairs of places on the lines of two views."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gcar_deploy.geometry.epipolar import epipolar_lines
from gcar_deploy.tubes.line_pairs import PLANE_MM, line_pairs
from tests.tree.shapes import fork
from tests.tubes.scenes import seen_as_masks, two_views


def _pairs():
    views = seen_as_masks(fork(), two_views())
    return views, line_pairs(views)


def test_every_point_that_both_views_show_is_one_of_the_pairs():
    _, pairs = _pairs()
    gap, _ = cKDTree(pairs.points_mm).query(fork().points())
    assert np.quantile(gap, 0.95) < 1.0


def test_pairs_lie_in_one_epipolar_plane_and_on_both_lines():
    views, pairs = _pairs()
    first, second = (one.pixels[at] for one, at in zip(pairs.places, pairs.at, strict=True))
    for view, pixels in zip(views, (first, second), strict=True):
        col, row = pixels.astype(int).T
        assert view.skeleton[row, col].all()
    lines = epipolar_lines(views[0].carm, views[1].carm, first)
    off = np.abs(lines[:, 0] * second[:, 0] + lines[:, 1] * second[:, 1] + lines[:, 2])
    assert off.max() * views[1].carm.pixel_at_isocenter_mm < 1.2 * PLANE_MM


def test_points_project_onto_their_places():
    views, pairs = _pairs()
    for view, one, at in zip(views, pairs.places, pairs.at, strict=True):
        gap = np.linalg.norm(view.carm.project(pairs.points_mm)[0] - one.pixels[at], axis=1)
        assert gap.max() * view.carm.pixel_at_isocenter_mm < PLANE_MM


def test_steps_join_neighbours_of_both_lines_once():
    _, pairs = _pairs()
    assert len(np.unique(np.sort(pairs.steps, axis=1), axis=0)) == len(pairs.steps)
    for one, at in zip(pairs.places, pairs.at, strict=True):
        ends = at[pairs.steps]
        gap = np.linalg.norm(np.diff(one.pixels[ends], axis=1)[:, 0], axis=1)
        assert gap.max() * 0.36 < 2.0
    assert pairs.steps.max() < len(pairs)


def test_widths_of_a_true_pair_agree():
    _, pairs = _pairs()
    near = cKDTree(fork().points()).query(pairs.points_mm)[0] < 0.7
    assert np.median(pairs.misfit[near]) < 0.2
    assert np.median(pairs.radius_mm[near]) == pytest.approx(
        float(np.median(fork().radii())), rel=0.4
    )


def test_a_likely_catheter_has_no_places():
    views = seen_as_masks(fork(), two_views())
    wire = [
        dataclasses.replace(view, device=np.full(view.mask.shape, 0.9, np.float32))
        for view in views
    ]
    assert line_pairs(wire) is None


def test_without_lines_there_are_no_pairs():
    views = [
        dataclasses.replace(view, skeleton=np.zeros(view.mask.shape, bool))
        for view in seen_as_masks(fork(), two_views())
    ]
    assert line_pairs(views) is None
