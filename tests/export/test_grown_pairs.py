"""Grown trees hang together and thin out, their pictures show them, and the table counts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gcar_export.scenes.grown_trees import grown_tree
from gcar_export.scenes.thorax import exposure
from gcar_export.studies.grown_pairs import KINDS, carms, pair, table

SEEDS = range(12)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_grown_tree_is_one_tree_that_thins_out(seed):
    tree = grown_tree(np.random.default_rng(seed))
    first, *others = tree.vessels
    for vessel in tree.vessels:
        step = np.linalg.norm(np.diff(vessel.points_mm, axis=0), axis=1)
        assert step.min() > 0 and step.max() < 1.0
        assert vessel.radius_mm.min() > 0.2 and vessel.radius_mm.max() < 4
    for k, vessel in enumerate(others, start=1):
        before = np.concatenate([v.points_mm for v in tree.vessels[:k]])
        after = np.concatenate([v.points_mm for v in tree.vessels if v is not vessel])
        assert min(cKDTree(own).query(vessel.points_mm[0])[0] for own in (before, after)) < 1.0
    # Lesions apart, a side branch is no wider than what it comes from.
    middle = [float(np.median(v.radius_mm)) for v in tree.vessels]
    assert max(middle) == pytest.approx(np.median(first.radius_mm), rel=0.35)


def test_views_are_apart_and_see_the_tree():
    for seed in SEEDS:
        one, two = carms(np.random.default_rng(seed))
        assert 40 < np.degrees(np.arccos(one.axes[2] @ two.axes[2])) < 125
        pixel_mm = one.pixel_at_isocenter_mm
        assert 115 < pixel_mm * one.columns < 195


def test_vessels_are_dark_and_a_catheter_too():
    rng = np.random.default_rng(5)
    path = np.zeros((128, 128), np.float32)
    path[:, 60:68] = 3.0
    catheter = path.T.copy()
    for _ in range(5):
        shown = exposure(path, catheter, 0.3, rng)
        assert shown.min() >= 0 and shown.max() <= 255 and (shown == np.round(shown)).all()
        inner = shown[20:108, 20:108]
        for across in (inner, inner.T):
            inside = np.median(across[:, 42:46], axis=1)
            beside = np.median(across[:, [30, 31, 32, 55, 56, 57]], axis=1)
            assert np.median(inside - beside) < 0


@pytest.mark.parametrize("kind", KINDS)
def test_pictures_are_of_the_tree_and_the_same_again(kind):
    views, line = pair(3, 1, kind)
    again, _ = pair(3, 1, kind)
    for one, other in zip(views, again, strict=True):
        np.testing.assert_array_equal(one.pixels, other.pixels)
        column, row = np.rint(one.carm.project(line)[0]).astype(int).T
        on = one.pixels[row, column]
        if kind == "raw":
            assert on.mean() < one.pixels.mean()
        else:
            assert (on > 0).mean() > 0.99


def test_the_table_counts():
    rows = [("mask", 1.0, 0.5, "ok"), ("mask", 0.0, 0.0, "refused"), ("raw", 0.8, 0.8, "degraded")]
    said = table(rows)
    assert "| mask | 2 | 100.0 | 50.0 | 33.3 | 1 / 0 / 1 | 66.7 |" in said
    assert "| raw | 1 | 80.0 | 80.0 | 80.0 | 0 / 1 / 0 | - |" in said
