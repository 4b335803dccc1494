"""Borders that show nothing: what is cut, what is kept, and that they change nothing."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gcar_deploy.config import ImagingOptions
from gcar_deploy.imaging.border import shown_box
from gcar_deploy.imaging.extract import extract_vessels
from tests.imaging.phantoms import angiogram, raw_picture, tube_paths

PICTURE = raw_picture(tube_paths(), seed=4)


@pytest.mark.parametrize("kind", [cv2.BORDER_REPLICATE, cv2.BORDER_CONSTANT])
def test_a_border_is_cut_and_changes_no_vessel(kind: int) -> None:
    wide = cv2.copyMakeBorder(PICTURE, 7, 3, 0, 12, kind, value=5.0)
    assert shown_box(wide) == (7, 263, 0, 256)
    alone = extract_vessels(angiogram(PICTURE), ImagingOptions())
    found = extract_vessels(angiogram(wide), ImagingOptions())
    assert found.mask.shape == (266, 268) and found.carm.rows == 266
    np.testing.assert_array_equal(found.path_mm[7:-3, :-12], alone.path_mm)
    np.testing.assert_array_equal(found.skeleton[7:-3, :-12], alone.skeleton)
    assert not found.valid[:7].any() and not found.valid[:, -12:].any()


def test_a_background_without_noise_is_kept() -> None:
    paths = tube_paths()
    assert shown_box(paths) == (0, 256, 0, 256)
    assert shown_box(np.full((40, 40), 3.0, np.float32)) == (0, 40, 0, 40)


def test_too_little_left_is_left_whole() -> None:
    thin = np.zeros((64, 64), np.float32)
    thin[30:34] = np.random.default_rng(0).random((4, 64))
    assert shown_box(thin) == (0, 64, 0, 64)
