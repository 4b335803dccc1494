"""Pixels that are longer one way show the same vessel as square ones of the same field."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import RunOptions
from gcar_deploy.engine import Engine
from gcar_deploy.geometry.own_frame import own_frame
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.own_frame import in_own_frame
from gcar_deploy.imaging.square import square_point, square_scales, squared
from tests.hard.phantoms import (
    GRID,
    PAIR,
    angiogram,
    carm,
    distances,
    path_of,
    paths,
    raw,
    seven,
    straight,
)

#: rows, columns and spacing of one field of 154 x 154 mm
TALL = {"rows": 256, "columns": 128, "pixel_spacing_mm": (0.6, 1.2)}
WIDE = {"rows": 128, "columns": 256, "pixel_spacing_mm": (1.2, 0.6)}
FINE = {"rows": 256, "columns": 256, "pixel_spacing_mm": (0.6, 0.6)}
#: the same field a little smaller, whose views in the scene's own frame round to other sides
ROUNDED = [
    {"rows": 256, "columns": 128, "pixel_spacing_mm": (0.49, 0.98), "sdd_mm": 1299.0},
    {"rows": 256, "columns": 205, "pixel_spacing_mm": (0.71, 0.8875), "sdd_mm": 1265.0},
]
MASK = Intensity(kind="mask", polarity="bright", mm_per_count=None)


def views(first, second):
    return [carm(-30, -20, **first), carm(45, 25, **second)]


@pytest.fixture(scope="module")
def engine():
    return Engine(threads=1)


@pytest.mark.slow
@pytest.mark.parametrize("shapes", [(TALL, TALL), (WIDE, WIDE), (TALL, WIDE)])
@pytest.mark.parametrize("axis", [(0.0, 0.1, 1.0), (1.0, 0.1, -0.6)])
@pytest.mark.parametrize("kind", ["path_length", "mask"])
def test_a_tube_is_as_wide_as_it_is(engine, shapes, axis, kind):
    tree, taken = straight(axis, radius=2.0), views(*shapes)
    if kind == "path_length":
        pictures = paths(tree, taken)
    else:
        pictures = [
            angiogram(v, 255 * (path_of(tree, v) > 0), str(k), MASK, 8) for k, v in enumerate(taken)
        ]
    result = engine.reconstruct(pictures, GRID)
    assert result.quality.status == "ok"
    # A mask of every pixel that is touched is wider than the tube by up to half of a pixel.
    within = 0.03 if kind == "path_length" else 0.2
    assert abs(np.median(result.tree.radii()) / 2.0 - 1) < within
    assert np.median(distances(result.tree, tree)[0]) < 0.15
    for view, given in zip(result.views, taken, strict=True):
        assert view.mask.shape == view.path_mm.shape == (given.rows, given.columns)
        seen = path_of(tree, given) > 0.5
        assert (view.mask & seen).sum() > 0.9 * seen.sum()
        drawn = np.rint(given.project(result.tree.points())[0]).astype(int)
        assert view.mask[drawn[:, 1], drawn[:, 0]].mean() > 0.95


@pytest.mark.slow
def test_a_tree_is_the_one_of_square_pixels(engine):
    tree = seven()
    square = engine.reconstruct(paths(tree, views(FINE, FINE)), GRID)
    other = engine.reconstruct(paths(tree, views(TALL, WIDE)), GRID)
    assert other.quality.status == square.quality.status
    error, _ = distances(other.tree, tree)
    assert np.median(error) < np.median(distances(square.tree, tree)[0]) + 0.1
    assert other.tree.length_mm == pytest.approx(square.tree.length_mm, rel=0.05)


@pytest.mark.slow
def test_raw_pictures_come_back_on_their_own_pixels(engine):
    tree, taken = straight((0.0, 0.1, 1.0), radius=2.0), views(TALL, WIDE)
    result = engine.reconstruct(raw(tree, taken), GRID)
    assert abs(np.median(result.tree.radii()) / 2.0 - 1) < 0.15
    assert np.median(distances(result.tree, tree)[0]) < 0.3
    for view, given in zip(result.views, taken, strict=True):
        for found in (view.mask, view.valid, view.vesselness, view.device):
            assert found is None or found.shape == (given.rows, given.columns)


@pytest.mark.parametrize("shape", [TALL, WIDE, {"principal_point_px": (50.0, 81.0)} | TALL])
def test_points_and_what_is_drawn_go_with_the_pixels(shape):
    view = carm(-30, -20, **shape)
    points = np.random.default_rng(3).uniform(-30, 30, (20, 3))
    pixels = path_of(straight(), view)
    picture = dataclasses.replace(
        angiogram(view, pixels, "1"), mask=pixels > 0, painted=pixels > 3, bare=(pixels,)
    )
    done = squared(picture)
    new = done.carm
    assert abs(new.focal_px[0] / new.focal_px[1] - 1) < 1e-9
    for old, there in zip(view.project(points)[0], new.project(points)[0], strict=True):
        np.testing.assert_allclose(square_point(view, tuple(old)), there, atol=1e-9)
    assert done.enlarged == max(square_scales(view))
    shapes = {one.shape for one in (done.pixels, done.mask, done.painted, *done.bare)}
    assert shapes == {(new.rows, new.columns)}
    off = done.pixels - path_of(straight(), new)
    assert np.sqrt((off[done.mask] ** 2).mean()) < 0.4
    # the same millimetres of vessel over the field
    assert done.pixels.sum() == pytest.approx(2 * pixels.sum(), rel=1e-3)


@pytest.mark.parametrize("border", [(5, 3), (0, 1), (17, 40)])
@pytest.mark.parametrize("shape", [TALL, WIDE, {"principal_point_px": (50.3, 81.7)} | TALL])
def test_a_border_more_leaves_the_pixels_where_they_were(shape, border):
    view = carm(-30, -20, **shape)
    pixels = path_of(straight(), view)
    top, left = border
    column, row = view.principal_point
    wider = dataclasses.replace(
        view, rows=view.rows + top, columns=view.columns + left,
        principal_point_px=(column + left, row + top),
    )  # fmt: skip
    first = squared(angiogram(view, pixels, "1"))
    second = squared(angiogram(wider, np.pad(pixels, ((top, 0), (left, 0))), "1"))
    more = np.subtract(second.pixels.shape, first.pixels.shape)
    inside = second.pixels[more[0] :, more[1] :]
    # The first pixels may reach beyond the picture, where it goes on as at its edge.
    np.testing.assert_allclose(inside[2:, 2:], first.pixels[2:, 2:], atol=1e-5)
    offset = np.subtract(second.carm.principal_point, first.carm.principal_point)
    np.testing.assert_allclose(offset, more[::-1], atol=1e-9)


@pytest.mark.parametrize(
    "shape", [TALL, WIDE, {"principal_point_px": (50.3, 81.7)} | TALL, *ROUNDED]
)
def test_what_was_found_comes_back_on_the_pixels_that_were_given(engine, shape):
    tree, taken = straight((0.0, 0.1, 1.0), radius=2.0), views(shape, shape)
    pictures = paths(tree, taken)
    for given, found in zip(pictures, engine.reconstruct(pictures, GRID).views, strict=True):
        drawn = given.pixels * given.intensity.mm_per_count
        assert found.path_mm.sum() == pytest.approx(drawn.sum(), rel=2e-3)
        # Both lie on the same place.
        for axis in (0, 1):
            middles = [(p.sum(axis=1 - axis) @ np.arange(p.shape[axis])) / p.sum()
                       for p in (found.path_mm, drawn)]  # fmt: skip
            assert abs(middles[0] - middles[1]) < 0.05


@pytest.mark.parametrize("first", [TALL, *ROUNDED])
def test_marks_stay_on_what_they_mark(first):
    taken = views(first, WIDE)
    place = np.array([[4.0, -7.0, 12.0]])
    marked = tuple(tuple(v.project(place)[0][0].tolist()) for v in taken)
    frame = own_frame(taken, "ab")
    pictures, options = in_own_frame(
        frame, paths(straight(), taken), RunOptions(landmarks=(marked, (marked[0], None)))
    )
    for number, picture in enumerate(pictures):
        there = picture.carm.project(place - frame.origin_mm)[0][0]
        np.testing.assert_allclose(options.landmarks[0][number], there, atol=1e-3)
    assert options.landmarks[1][frame.place(1)] is None


def test_square_pixels_stay_as_they_are():
    picture = paths(straight())[0]
    assert squared(picture) is picture
    assert square_point(PAIR[0], (3.0, 4.0)) == (3.0, 4.0)
    assert square_point(carm(0, **TALL), None) is None


def test_very_long_pixels_make_no_picture_without_bounds():
    view = carm(0, rows=1000, columns=100, pixel_spacing_mm=(0.1, 10.0))
    rows, columns = squared(angiogram(view, np.zeros((1000, 100)), "1")).pixels.shape
    assert rows * columns <= 2.1 * 1000 * 100
    assert rows / columns == pytest.approx(1000 * 0.1 / (100 * 10.0), rel=0.02)
