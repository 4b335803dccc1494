"""Trees drawn on an even ground are seen whole, and nothing else is taken for such a picture."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from gcar_deploy.config import ImagingOptions
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.imaging.even_ground import shadow
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.types import Image, Mask
from tests.imaging.phantoms import dice

SIDE = 400
PIXEL_MM = 0.36
NO_HOLES = np.zeros((SIDE, SIDE), bool)
#: (col, row) corners and width of the vessels, pixels
VESSELS = (
    (((40, 60), (200, 150), (360, 330)), 17),
    (((200, 150), (220, 370)), 9),
    (((120, 105), (60, 300)), 3),
)


def drawn(depth: bool) -> tuple[Image, Mask]:
    """Bright vessels on 0: flat areas of 1, or as deep as round ones; and where they are."""
    row, col = np.indices((SIDE, SIDE))
    out = np.zeros((SIDE, SIDE))
    for corners, width in VESSELS:
        for (x0, y0), (x1, y1) in itertools.pairwise(corners):
            t = ((col - x0) * (x1 - x0) + (row - y0) * (y1 - y0)) / (
                (x1 - x0) ** 2 + (y1 - y0) ** 2
            )
            t = np.clip(t, 0, 1)
            off = np.hypot(col - x0 - t * (x1 - x0), row - y0 - t * (y1 - y0))
            chord = np.sqrt(np.clip(1 - (off / (width / 2)) ** 2, 0, None)) * width / 17
            out = np.maximum(out, chord)
    mask = out > 0
    return (out if depth else mask.astype(float)).astype(np.float32), mask


@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_the_whole_tree_is_seen_to_the_rim(depth: bool, noise: float) -> None:
    picture, mask = drawn(depth)
    grain = np.random.default_rng(1).normal(0, noise, picture.shape)
    found = shadow((7 + 40 * (picture + grain)).astype(np.float32), NO_HOLES, PIXEL_MM)
    assert found is not None
    assert found.flat is not depth
    assert dice(found.mask, mask) > 0.97


def test_gain_and_offset_change_nothing() -> None:
    picture, _ = drawn(True)
    one, other = (
        shadow(p.astype(np.float32), NO_HOLES, PIXEL_MM) for p in (picture, 300 * picture - 80)
    )
    assert one is not None
    assert other is not None
    assert np.array_equal(one.mask, other.mask)


@pytest.mark.parametrize("margin", [2, 10, 30])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_empty_ground_that_is_cut_off_changes_nothing(margin: int, noise: float) -> None:
    grain = np.random.default_rng(1).normal(0, noise, NO_HOLES.shape)
    picture, mask = drawn(True)
    picture = (picture + grain).astype(np.float32)
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    part = np.s_[rows[0] - margin : rows[-1] + margin + 1,
                 columns[0] - margin : columns[-1] + margin + 1]  # fmt: skip
    whole = shadow(picture, NO_HOLES, PIXEL_MM)
    cut = shadow(picture[part], NO_HOLES[part], PIXEL_MM)
    assert whole is not None
    assert cut is not None
    if noise:
        assert dice(cut.mask, whole.mask[part]) > 0.995
    else:
        assert np.array_equal(cut.mask, whole.mask[part])


def test_letters_are_no_vessel() -> None:
    picture, mask = drawn(False)
    corner = np.s_[:45, 290:]
    written = picture.astype(np.uint8)
    cv2.putText(written, "LAO", (300, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.4, 1)
    found = shadow(written.astype(np.float32), NO_HOLES, PIXEL_MM)
    assert found is not None
    assert not found.mask[corner].any()
    assert dice(found.mask, mask) > 0.99


def test_letters_blacker_than_any_vessel_are_none() -> None:
    picture, mask = drawn(True)
    for column in range(300, 360, 6):
        picture[10:30, column : column + 2] = 3.0
    found = shadow(picture, NO_HOLES, PIXEL_MM)
    assert found is not None
    assert not found.mask[:45, 290:].any()
    assert dice(found.mask, mask) > 0.97


@pytest.mark.parametrize("radius", [190, 400])
def test_what_runs_across_the_whole_picture_is_no_vessel_of_it(radius: int) -> None:
    """Ribs, wires: the ground is that of a body, whatever lies beside them."""
    picture, _ = drawn(True)
    row, col = np.indices(picture.shape)
    holes = np.hypot(row - 199.5, col - 199.5) > radius
    band = np.exp(-(((row - 200 - 0.2 * col) / 8) ** 2)).astype(np.float32)
    assert shadow(picture + 0.4 * band, holes, PIXEL_MM) is None


def test_grain_that_is_coarser_in_dark_parts_is_no_vessel() -> None:
    """A logarithm makes of even noise on a dark cloud many times what it makes beside it."""
    picture, mask = drawn(True)
    row, col = np.indices(picture.shape)
    cloud = np.hypot(row - 80, col - 310) < 45
    grain = np.random.default_rng(8).normal(0, 1, picture.shape)
    assert shadow((picture + 0.01 * grain).astype(np.float32), NO_HOLES, PIXEL_MM) is not None
    rough = picture + np.where(cloud, 0.06, 0.01) * grain
    assert not (cloud & mask).any()
    assert shadow(rough.astype(np.float32), NO_HOLES, PIXEL_MM) is None


def test_what_comes_in_from_one_side_is_drawn_with_the_vessels() -> None:
    picture, mask = drawn(True)
    row, col = np.indices(picture.shape)
    come = np.exp(-(((row - 200 - 0.2 * col) / 8) ** 2)) * (col < 150)
    found = shadow((picture + 0.4 * come).astype(np.float32), NO_HOLES, PIXEL_MM)
    assert found is not None
    assert (found.mask & mask).sum() > 0.95 * mask.sum()


@pytest.mark.parametrize("noise", [0.0, 0.06])
def test_light_may_fall_off_and_grain_may_be_coarse(noise: float) -> None:
    picture, mask = drawn(True)
    row, col = np.indices(picture.shape) / SIDE
    light = 2.0 - (row - 0.4) ** 2 - 0.7 * col
    grain = np.random.default_rng(3).normal(0, noise, picture.shape)
    found = shadow((picture - light + grain).astype(np.float32), NO_HOLES, PIXEL_MM)
    assert found is not None
    assert dice(found.mask, mask) > 0.9


@pytest.mark.parametrize("what", ["noisy", "cloudy", "blob", "both ways", "holes"])
def test_other_pictures_are_left_to_the_filters(what: str) -> None:
    picture, _ = drawn(True)
    row, col = np.indices(picture.shape) / SIDE
    holes = NO_HOLES
    if what == "noisy":
        picture = picture + np.random.default_rng(2).normal(0, 0.4, picture.shape)
    if what == "shaded":
        picture = picture + col
    if what == "cloudy":
        cloud = cv2.GaussianBlur(np.random.default_rng(4).normal(0, 1, picture.shape), (0, 0), 12)
        picture = picture + 0.2 * cloud / cloud.std()
    if what == "blob":  # half of the picture is saturated, the rest is anatomy
        picture = picture + (np.hypot(row - 0.7, col - 0.2) < 0.2)
    if what == "both ways":
        picture = picture - 0.5 * (row < 0.1)
    if what == "holes":
        holes = ~NO_HOLES
    assert shadow(picture.astype(np.float32), holes, PIXEL_MM) is None


@pytest.mark.parametrize("grain", [0.01, 0.06])
@pytest.mark.parametrize("height", [-0.6, 0.3, 1.0])
def test_a_hill_of_the_ground_is_no_vessel(height: float, grain: float) -> None:
    picture, mask = drawn(True)
    row, col = np.indices(picture.shape) / SIDE
    hill = height * np.exp(-((col - 0.2) ** 2 + (row - 0.9) ** 2) / (2 * 0.2**2))
    noise = np.random.default_rng(5).normal(0, grain, picture.shape)
    found = shadow((picture + hill + noise).astype(np.float32), NO_HOLES, PIXEL_MM)
    assert found is None or (found.mask & ~mask).sum() < 0.1 * mask.sum()


@pytest.mark.parametrize(("height", "width"), [(0.08, 25), (0.1, 15)])
def test_speckles_on_the_top_of_a_low_cloud_are_no_vessel(height: float, width: float) -> None:
    picture, mask = drawn(True)
    row, col = np.indices(picture.shape)
    cloud = height * np.exp(-((row / width) ** 2 + ((col - 100) / 60) ** 2) / 2)
    noise = np.random.default_rng(2).normal(0, 0.01, picture.shape)
    found = shadow((picture + cloud + noise).astype(np.float32), NO_HOLES, PIXEL_MM)
    assert found is not None
    assert (found.mask & ~mask).sum() < 20
    assert dice(found.mask, mask) > 0.95


@pytest.mark.parametrize(("depth", "kind"), [(False, "mask"), (True, "raw")])
@pytest.mark.parametrize("dark", [True, False])
def test_a_drawn_tree_is_read_without_any_model(depth: bool, kind: str, dark: bool) -> None:
    picture, mask = drawn(depth)
    grey = 20 + 200 * (1 - picture if dark else picture)
    seen = Angiogram.without_geometry(
        "1", (np.rint(grey).astype(np.float32), 8, ""), Intensity(kind="raw"), 0.3
    )
    found = extract_vessels(seen, ImagingOptions(segmenter="classic"))
    assert found.kind == kind
    assert dice(found.mask, mask) > 0.95
    # A vessel of 17 pixels is 17 pixels deep in its middle.
    line = found.skeleton & (cv2.distanceTransform(mask.astype(np.uint8), 2, 5) > 7)
    assert np.median(found.path_mm[line]) == pytest.approx(17 * 0.3, rel=0.15)
