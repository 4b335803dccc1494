"""A picture turned by right angles with its geometry is the same picture."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import PredictOptions, RunOptions
from gcar_deploy.engine import Engine
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.own_frame import own_frame
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.imaging.own_frame import found_as_given, in_own_frame
from gcar_deploy.imaging.upright import turned_point, upright
from gcar_deploy.pose.motion import Motion
from gcar_deploy.selftest import tiny_case
from tests.hard.phantoms import angiogram, carm, path_of, straight

POINTS = np.random.default_rng(5).uniform(-25, 25, (12, 3))
LONG = {"rows": 130, "columns": 90, "pixel_spacing_mm": (0.9, 1.3),
        "principal_point_px": (40.25, 70.5), "detector_rotation_deg": 7.0}  # fmt: skip


def on_its_side(view: CArm, turns: int) -> CArm:
    """The view of the picture ``np.rot90(picture, turns)``, worked out from the contract's text."""
    for _ in range(turns):
        column, row = view.principal_point
        view = dataclasses.replace(
            view, rows=view.columns, columns=view.rows,
            pixel_spacing_mm=view.pixel_spacing_mm[::-1],
            principal_point_px=(row, view.columns - 1 - column),
            detector_rotation_deg=(view.detector_rotation_deg - 90 + 180) % 360 - 180,
        )  # fmt: skip
    return view


def pixel_on_its_side(view: CArm, pixel: np.ndarray, turns: int) -> np.ndarray:
    """Where a pixel is found in the turned picture: by marking it and looking for the mark."""
    picture = np.zeros((view.rows, view.columns))
    picture[pixel[1], pixel[0]] = 1
    return np.argwhere(np.rot90(picture, turns))[0][::-1]


@pytest.mark.parametrize("turns", range(4))
def test_a_view_on_its_side_shows_what_the_turned_picture_shows(turns: int) -> None:
    view = carm(-30, -20, **LONG)
    lying = on_its_side(view, turns)
    here, there = view.project(POINTS)[0], lying.project(POINTS)[0]
    for old, new in zip(here, there, strict=True):
        assert np.allclose(turned_point(view, tuple(old), turns), new, atol=1e-9)
    for pixel in ((0, 0), (89, 3), (20, 129)):
        expected = pixel_on_its_side(view, np.array(pixel), turns)
        assert np.allclose(turned_point(view, pixel, turns), expected)


@pytest.mark.parametrize("rotation", [-180.0, -136.0, -90.0, -45.0, 0.0, 44.0, 45.0, 100.0, 179.0])
def test_pictures_stand_upright_to_an_eighth_of_a_turn(rotation: float) -> None:
    view = carm(-30, -20, **{**LONG, "detector_rotation_deg": rotation})
    stood, turns = upright(view)
    assert -45.0 <= stood.detector_rotation_deg < 45.0
    assert (turns == 0) is (-45.0 <= rotation < 45.0)
    here, there = view.project(POINTS)[0], stood.project(POINTS)[0]
    for old, new in zip(here, there, strict=True):
        assert np.allclose(turned_point(view, tuple(old), turns), new, atol=1e-3)


@pytest.mark.parametrize("turns", [(1, 0), (2, 2), (3, 1), (0, 3)])
@pytest.mark.parametrize("kind", ["mask", "path_length"])
def test_the_scene_and_what_is_found_are_the_same(turns: tuple[int, int], kind: str) -> None:
    tree, views = straight(radius=2.0), [carm(-30, -20, **LONG), carm(45, 25)]
    scale = 0.01 if kind == "path_length" else None
    what = Intensity(kind=kind, polarity="bright", mm_per_count=scale)
    pixels = [np.rint(path_of(tree, view) / 0.01) for view in views]
    place = tuple(tuple(view.project(POINTS[:1])[0][0].tolist()) for view in views)
    told = []
    for each in ((0, 0), turns):
        lying = [on_its_side(view, k) for view, k in zip(views, each, strict=True)]
        pictures = [
            angiogram(view, np.rot90(p, k), str(n), what, 16)
            for n, (view, p, k) in enumerate(zip(lying, pixels, each, strict=True))
        ]
        mark = tuple(turned_point(v, p, k) for v, p, k in zip(views, place, each, strict=True))
        frame = own_frame(lying, "ab")
        seen, options = in_own_frame(frame, pictures, RunOptions(landmarks=(mark,)))
        found = [extract_vessels(one, options.imaging) for one in seen]
        told.append((seen, options.landmarks[0], found_as_given(frame, found)))
    (seen, marks, found), (seen_2, marks_2, found_2) = told
    assert [one.carm for one in seen] == [one.carm for one in seen_2]
    assert np.allclose(marks, marks_2, atol=1e-6)
    for one, other in zip(seen, seen_2, strict=True):
        assert np.array_equal(one.pixels, other.pixels)
    for one, other, k in zip(found, found_2, turns, strict=True):
        assert other.mask.shape == (other.carm.rows, other.carm.columns)
        for name in ("mask", "skeleton", "path_mm", "valid"):
            assert np.array_equal(np.rot90(getattr(one, name), k), getattr(other, name)), name


@pytest.mark.slow
def test_the_tree_is_the_same() -> None:
    angiograms, grid, _ = tiny_case()
    engine = Engine(threads=1, options=RunOptions(predict=PredictOptions(predictor="none")))
    lying = [
        dataclasses.replace(
            a, carm=on_its_side(a.carm, k), pixels=np.ascontiguousarray(np.rot90(a.pixels, k))
        )
        for a, k in zip(angiograms, (1, 2), strict=True)
    ]
    base, other = engine.reconstruct(angiograms, grid), engine.reconstruct(lying, grid)
    assert base.status == other.status
    assert np.allclose(base.tree.points(), other.tree.points(), atol=1e-6)


@pytest.mark.parametrize("turns", range(4))
def test_a_motion_goes_with_the_picture(turns: int) -> None:
    rng, view = np.random.default_rng(2), carm(-30, -20, **LONG)
    motion = Motion(
        nodes_mm=rng.uniform(-30, 30, (7, 2)), weights=rng.normal(0, 1, 7),
        direction=np.array([0.6, -0.8]), rms_mm=1.0,
    )  # fmt: skip
    lying, pixels = on_its_side(view, turns), rng.uniform(0, 80, (20, 2))
    moved = pixels + motion.at(view, pixels)
    there = np.array([turned_point(view, tuple(p), turns) for p in pixels])
    moved_there = there + motion.turned(turns).at(lying, there)
    for old, new in zip(moved, moved_there, strict=True):
        assert np.allclose(turned_point(view, tuple(old), turns), new, atol=1e-9)
