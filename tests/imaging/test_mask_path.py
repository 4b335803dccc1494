"""Chords from masks against closed forms."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from gcar_deploy.config import ImagingOptions
from gcar_deploy.errors import RefusedError
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.imaging.mask_path import mask_path
from gcar_deploy.imaging.skeleton import skeletonize
from tests.imaging.phantoms import PIXEL_MM, angiogram, raw_picture, tube_paths


def ball(size: int, middle: tuple[float, float], radius_mm: float, pixel_mm: float):
    """Mask by pixel centres and mean chord of a straight tube along the columns' diagonal."""
    n = size * 8
    row, column = (np.indices((n, n)) + 0.5) / 8 - 0.5
    gap = ((column - middle[0]) * 0.6 - (row - middle[1]) * 0.8) * pixel_mm
    chord = 2 * np.sqrt(np.clip(radius_mm**2 - gap**2, 0, None))
    return (chord > 0)[4::8, 4::8], chord.reshape(size, 8, size, 8).mean((1, 3))


@pytest.mark.parametrize("pixel_mm", [0.15, 0.3, 0.55])
@pytest.mark.parametrize("radius_mm", [0.6, 1.2, 2.0])
def test_a_straight_tube_has_the_chord_of_a_round_vessel(pixel_mm: float, radius_mm: float) -> None:
    errors = []
    for offset in (0.0, 0.21, 0.47):
        mask, truth = ball(96, (47.3 + offset, 48.1), radius_mm, pixel_mm)
        found = mask_path(mask, pixel_mm)
        middle = np.zeros_like(mask)
        middle[20:-20, 20:-20] = True  # away from the picture's border
        errors.append(found[mask & middle].mean() / truth[mask & middle].mean() - 1)
        wrong = np.abs(found - truth)[mask & middle].mean()
        assert wrong < 0.25 * pixel_mm + 0.07 * radius_mm
    assert abs(np.mean(errors)) < 0.09


def test_a_tree_of_tubes_is_as_thick_as_it_is_wide() -> None:
    truth = tube_paths()
    found = mask_path(truth > 0.5, PIXEL_MM)
    inside = truth > 1.0
    assert np.median(found[inside] / truth[inside]) == pytest.approx(1, abs=0.06)
    assert np.abs(found - truth)[inside].mean() < 0.2


def test_a_line_one_pixel_wide_is_a_vessel() -> None:
    mask = np.zeros((40, 40), bool)
    mask[np.arange(5, 35), np.arange(5, 35)] = True
    mask[20, 2:18] = True
    found = mask_path(mask, 0.3)
    assert (found[mask] > 0.2).all() and (found[mask] < 0.5).all()
    assert (found[~mask] == 0).all()


@pytest.mark.parametrize("corners", [False, True])
@pytest.mark.parametrize("kind", ["mask", "raw"])
def test_a_thinned_mask_is_refused(kind: str, corners: bool) -> None:
    """Lines that touch at corners alone, or run round every corner."""
    whole = tube_paths() > 0.5
    thin = skeletonize(whole)
    if corners:
        thin |= np.roll(thin, 1, 0) & (np.roll(thin, 1, 1) | np.roll(thin, -1, 1))
    assert thin.sum() < 0.25 * whole.sum()

    def view(mask: np.ndarray, pixel_mm: float = PIXEL_MM) -> VesselImage:
        if kind == "mask":
            given = angiogram(mask, "mask", pixel_mm=pixel_mm)
        else:
            given = dataclasses.replace(
                angiogram(raw_picture(tube_paths(pixel_mm=pixel_mm)), pixel_mm=pixel_mm), mask=mask
            )
        return extract_vessels(given, ImagingOptions(segmenter="classic"))

    with pytest.raises(RefusedError, match=r"view 2: the mask's lines are one pixel wide"):
        view(thin)
    view(whole)
    assert view(cv2.dilate(thin.astype(np.uint8), np.ones((2, 2))) > 0).mask.any()
    assert view(thin, pixel_mm=1.0).mask.any()


def test_an_x_ray_picture_and_an_inverted_mask_are_no_masks() -> None:
    whole = tube_paths() > 0.5
    bright = raw_picture(tube_paths())
    # A third as bright but for one spot: little is above half, yet nearly all is grey.
    faint = np.where(np.arange(bright.size).reshape(bright.shape) == 0, 3 * bright.max(), bright)
    soft = cv2.GaussianBlur(whole.astype(np.float32), (0, 0), 2.0)
    for pixels, told in ((bright, "above half"), (~whole, "above half"), (faint, "neither")):
        with pytest.raises(RefusedError, match=f"view 2: intensity.kind is mask, but .*% .*{told}"):
            extract_vessels(angiogram(pixels, "mask"), ImagingOptions())
    assert extract_vessels(angiogram(soft, "mask"), ImagingOptions()).mask.any()


def test_an_empty_mask_has_no_path() -> None:
    assert not mask_path(np.zeros((20, 30), bool), 0.3).any()


def test_the_place_in_the_picture_does_not_matter() -> None:
    mask = tube_paths() > 0.5
    moved = np.zeros((300, 310), bool)
    moved[31:287, 17:273] = mask
    np.testing.assert_array_equal(mask_path(moved, 0.3)[31:287, 17:273], mask_path(mask, 0.3))
