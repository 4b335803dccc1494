"""Sections of made vessels: area whatever the shape, what overlaps and what no view shows."""

import dataclasses

import numpy as np
import pytest

from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.measure.sections import measure_sections, with_diameters
from gcar_deploy.measure.signals import read_signal
from gcar_deploy.tree.tree import Tree
from tests.tree.shapes import branch
from tests.tubes.scenes import seen, two_views

LINE = np.linspace([-20.0, -6.0, 15.0], [22.0, 9.0, -14.0], 120)
ARC = np.linalg.norm(LINE - LINE[0], axis=1)


def tree_of(*radii, lines=(LINE,)):
    lines = lines or (LINE,)
    branches = tuple(
        branch(line, r, 2 * k, 2 * k + 1)
        for k, (line, r) in enumerate(zip(lines, radii, strict=True))
    )
    return Tree(nodes_mm=np.concatenate([line[[0, -1]] for line in lines]), branches=branches)


def signals_of(tree, kind="path_length", noise_mm=0.0):
    """The oracle's paths of a tree, as one kind of picture or another."""
    rng = np.random.default_rng(1)
    out = []
    for view in seen(tree, two_views(512, 0.3)):
        path = view.path_mm + noise_mm * rng.normal(size=view.path_mm.shape)
        if kind == "raw":
            pixels, how = 200.0 * np.exp(-0.1 * path) + 0.0 * path, ("raw", "dark", None)
        elif kind == "mask":
            pixels, how = 255.0 * (path > 0.05), ("mask", "bright", None)
        else:
            pixels, how = path / 0.001, ("path_length", "bright", 0.001)
        angiogram = Angiogram(
            view_id=view.view_id, carm=view.carm, pixels=pixels.astype(np.float32), bit_depth=16,
            intensity=Intensity(kind=how[0], polarity=how[1], mm_per_count=how[2]), sha256="",
        )  # fmt: skip
        out.append(read_signal(angiogram, view))
    return out


def narrowed(share, healthy=1.5, length_mm=9.0):
    off = np.clip(2 * np.abs(ARC - ARC[60]) / length_mm, 0, 1)
    return healthy * (1 - share * 0.5 * (1 + np.cos(np.pi * off)))


@pytest.mark.parametrize(("kind", "limit"), [("path_length", 0.05), ("raw", 0.1), ("mask", 0.2)])
def test_a_narrow_core_is_found_though_the_tube_rounds_it_off(kind, limit):
    truth, start = narrowed(0.6), narrowed(0.3, 1.6, 14.0)
    (found,) = measure_sections(tree_of(start), signals_of(tree_of(truth), kind))
    true = 2 * np.interp(found.arc_mm, ARC, truth)
    inner = slice(8, -8)
    assert np.abs(found.diameter_mm - true)[inner].mean() < limit
    assert abs(found.diameter_mm[inner].min() - 2 * truth.min()) < 2 * limit
    assert found.measured[inner].all()


def test_sigma_covers_the_error_under_noise():
    truth = narrowed(0.5)
    signals = signals_of(tree_of(truth), noise_mm=0.15)
    (found,) = measure_sections(tree_of(1.1 * truth), signals)
    z = (found.diameter_mm - 2 * np.interp(found.arc_mm, ARC, truth)) / found.sigma_mm
    assert 0.05 < np.mean(z[8:-8] ** 2) < 2.0


def test_another_vessel_in_front_is_marked_and_does_no_harm():
    views = two_views(512, 0.3)
    # Behind the first vessel in the first view, well beside it in the second.
    ray = LINE[60] - views[0].source_mm
    middle = LINE[60] + 15.0 * ray / np.linalg.norm(ray)
    side = np.cross(LINE[-1] - LINE[0], ray)
    other = middle + np.linspace(-15, 15, 60)[:, None] * side / np.linalg.norm(side)
    both = tree_of(np.full(120, 1.5), np.full(60, 1.2), lines=(LINE, other))
    first, _ = measure_sections(both, signals_of(both))
    crossing = np.argmin(np.abs(first.arc_mm - ARC[60]))
    assert first.overlapped[0, crossing] and not first.overlapped[1, crossing]
    # What one view alone says is trusted less.
    assert first.sigma_mm[crossing] > 2 * np.median(first.sigma_mm)
    assert np.isnan(first.width_mm[0, crossing]) and np.isfinite(first.width_mm[1, crossing])
    assert np.abs(first.diameter_mm[8:-8] - 3.0).max() < 0.15
    away = slice(8, crossing - 12)
    assert not first.overlapped[:, away].any()


def test_a_vessel_that_no_picture_shows_is_not_measured():
    shown = tree_of(np.full(120, 1.5))
    beside = tree_of(np.full(120, 1.5), lines=(LINE + np.array([0.0, 0.0, 9.0]),))
    (found,) = measure_sections(beside, signals_of(shown))
    assert found.measured.mean() < 0.1


def test_end_on_counts_for_nothing():
    view = two_views(512, 0.3)[0]
    way = view.axes[2] + 0.1 * view.axes[0]
    line = np.linspace(-10, 10, 60)[:, None] * way
    tree = tree_of(np.full(60, 1.5), lines=(line,))
    (found,) = measure_sections(tree, signals_of(tree))
    assert np.isnan(found.width_mm[0]).all() and np.isfinite(found.width_mm[1]).any()


def test_the_tree_takes_the_diameters():
    tree = tree_of(np.full(120, 1.5))
    (found,) = measure_sections(tree, signals_of(tree))
    wide = dataclasses.replace(found, diameter_mm=np.full(len(found.arc_mm), 4.0))
    np.testing.assert_allclose(with_diameters(tree, (wide,)).radii(), 2.0)
    assert measure_sections(Tree(nodes_mm=np.zeros((0, 3)), branches=()), []) == ()
