"""What reaches the predictor: masks, noise, a segmentation's errors, against closed forms."""

import dataclasses

import cv2
import numpy as np
import pytest

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.tree.line_votes import THINNEST_CELLS
from gcar_export.scenes.capsules import Capsules
from gcar_export.scenes.gantry import Field, clinical_views, focused, random_rotation
from gcar_export.scenes.pictures import PATH_ERRORS, as_mask, spoil, with_noise
from gcar_export.scenes.render import path_lengths
from gcar_export.training.dataset import given, training_scene, truth_at
from gcar_export.training.examinations import (
    CLINICAL_CELLS_MM,
    FINE_CELLS_MM,
    MAX_POINTS,
    SceneOptions,
)

CARM = CArm(
    primary_angle_deg=0, secondary_angle_deg=0, sod_mm=765, sdd_mm=1100, rows=256, columns=256,
    pixel_spacing_mm=(0.4, 0.4),
)  # fmt: skip


def tube(radius: float) -> Capsules:
    """A straight tube along the patient's axis, across the rays and off every pixel centre."""
    z = np.linspace(-60, 60, 61)
    line = np.stack([np.full(61, 0.07), np.full(61, 0.03), z], axis=1)
    return Capsules(line[:-1], line[1:], np.full(60, radius))


def shadow(radius: float, carm: CArm = CARM):
    return path_lengths(carm, *dataclasses.astuple(tube(radius)))


@pytest.mark.parametrize("radius", [0.3, 0.8, 2.0])
def test_a_mask_is_as_wide_as_the_shadow_of_a_tube(radius):
    rng = np.random.default_rng(0)
    path = given(rng, shadow(radius), CARM.pixel_at_isocenter_mm, "mask", False)
    # The rays that touch a circle of radius r at distance SOD leave it at asin(r / SOD).
    width_px = 2 * 1100 * np.tan(np.arcsin(radius / 765)) / 0.4
    rows = path[100:156]
    assert (rows > 0).sum(axis=1).mean() == pytest.approx(width_px, abs=1.0)
    assert rows.max(axis=1).mean() == pytest.approx(2 * radius, rel=0.2)


def test_noise_leaves_the_mean_and_an_empty_background():
    pixel = CARM.pixel_at_isocenter_mm
    exact = shadow(1.5)
    inside = cv2.erode((exact > 1).astype(np.uint8), np.ones((3, 3))) > 0
    far = cv2.dilate((exact > 0).astype(np.uint8), np.ones((9, 9))) == 0
    spread = []
    for seed in range(20):
        noisy = with_noise(np.random.default_rng(seed), exact, pixel)
        off = (noisy - exact)[inside]
        spread.append(off.std())
        assert abs(off.mean()) < 5 * off.std() / np.sqrt(inside.sum()) + 0.02
        assert (noisy[far] > 0).mean() < 0.01 and (noisy >= 0).all()
    assert min(spread) < 0.03 and max(spread) > 0.1


def test_spoilt_edges_stay_within_a_few_pixels_and_holes_are_few():
    mask = shadow(1.5) > 0
    near = cv2.dilate(mask.astype(np.uint8), np.ones((9, 9))) > 0
    lost, beyond = [], []
    for seed in range(20):
        out = spoil(np.random.default_rng(seed), mask, CARM.pixel_at_isocenter_mm)
        beyond.append((out & ~near).sum())  # spurs alone reach further
        lost.append(1 - (out & mask).sum() / mask.sum())
    assert 0.02 < np.mean(lost) < 0.4 and np.mean(beyond) < 40
    a, b = (spoil(np.random.default_rng(3), mask, 0.3) for _ in range(2))
    np.testing.assert_array_equal(a, b)
    assert not spoil(np.random.default_rng(0), np.zeros_like(mask), 0.3).any()


def test_brightness_does_not_reach_a_mask():
    path = shadow(1.5)
    a, b = (as_mask(np.random.default_rng(0), p, 0.28, False) for p in (path, 3 * path))
    np.testing.assert_array_equal(a, b)


def test_a_focused_view_shows_all_of_its_field_and_moves_nothing():
    rng = np.random.default_rng(1)
    field = Field(np.array([20.0, -15.0, 8.0]), 30.0)
    for carm in clinical_views(rng, 4, 0.25, anywhere=True):
        seen = focused(carm, field)
        ball = rng.normal(size=(500, 3))
        ball = field.middle_mm + field.radius_mm * ball / np.linalg.norm(ball, axis=1)[:, None]
        pixels, _ = seen.project(ball)
        assert (pixels > 0).all() and (pixels < seen.columns - 1).all()
        before, _ = carm.project(ball)
        shift = pixels - before
        np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=1e-6)


def test_rotations_are_rotations():
    rng = np.random.default_rng(2)
    for largest in (None, 40.0):
        for _ in range(20):
            turn = random_rotation(rng, largest)
            np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(turn) == pytest.approx(1)
            angle = np.rad2deg(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
            assert largest is None or angle <= largest


@pytest.mark.parametrize(("radius", "counted"), [(0.2, THINNEST_CELLS), (1.5, 1.5)])
def test_a_thin_vessel_fills_as_many_cells_as_the_thinnest_that_counts(radius, counted):
    grid = np.stack(np.meshgrid(*[np.arange(-4, 5)] * 2, np.arange(-3, 4), indexing="ij"), -1)
    points = grid.reshape(-1, 3).astype(float)
    truth, _, told = truth_at(points, 1.0, tube(radius), tube(radius))
    assert truth.sum() / 7 == pytest.approx(np.pi * counted**2, rel=0.05)
    assert np.nanmax(told) == pytest.approx(radius)


def test_oval_lumens_keep_their_area_and_their_line():
    points = np.stack(np.meshgrid(*[np.linspace(-4, 4, 81)] * 2, [0.0], indexing="ij"), -1)
    line = tube(1.5)
    for seed in range(5):
        oval = line.oval(np.random.default_rng(seed))
        truth, offset, radius = truth_at(points.reshape(-1, 3), 0.1, oval, line)
        assert truth.sum() * 0.01 == pytest.approx(np.pi * 1.5**2, rel=0.15)
        inside = points.reshape(-1, 3)[truth > 0.5][:, :2]
        low, high = np.sqrt(np.linalg.eigvalsh(np.cov((inside - inside.mean(0)).T)))
        assert 1.05 < high / low < 2
        nearest = (points.reshape(-1, 3) + offset)[truth > 0]
        np.testing.assert_allclose(nearest[:, :2], [[0.07, 0.03]] * len(nearest))
        np.testing.assert_allclose(radius[truth > 0], 1.5)


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(PATH_ERRORS))
def test_every_kind_of_input_can_be_asked_for(kind):
    inputs = tuple(float(k == kind) for k in PATH_ERRORS)
    fine = SceneOptions(inputs=inputs, fine_share=1.0, paper_share=0.0)
    clinical = dataclasses.replace(fine, fine_share=0.0)
    for options, regime, (low, high) in (
        (fine, "fine", FINE_CELLS_MM), (clinical, "clinical", CLINICAL_CELLS_MM),
    ):  # fmt: skip
        scene = training_scene(21, 1, options)
        assert scene.kind == f"{regime}-{kind}" and scene.path_error == PATH_ERRORS[kind]
        assert low <= scene.spacing_mm <= high and len(scene.hull) < MAX_POINTS
        if kind != "noisy":
            assert all(known == (kind == "exact") for _, _, known in scene.views)
