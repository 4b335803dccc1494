"""Straight and round shutters are found, dark corners and dark pictures are none."""

from __future__ import annotations

import numpy as np
import pytest

from gcar_deploy.imaging.collimator import collimator
from tests.imaging.phantoms import raw_picture, tube_paths


@pytest.mark.parametrize("size", [256, 1300])
def test_collimator_is_found_and_a_dark_picture_is_not_one(size):
    picture = raw_picture(tube_paths(size, oversample=2))
    row, column = np.indices(picture.shape)
    outside = np.hypot(row - size / 2, column - size / 2) > 0.547 * size
    holes = collimator(np.where(outside, np.float32(6), picture))
    assert holes[outside].mean() > 0.95
    assert holes[~outside].mean() < 0.12
    assert not collimator(picture).any()
    assert not collimator(np.full((64, 64), 3, np.float32)).any()


@pytest.mark.parametrize("radius", [0.49, 0.5, 0.51])
@pytest.mark.parametrize("size", [256, 768])
def test_of_a_round_shutter_at_the_border_nothing_is_left(size, radius):
    """The wedges between circle and border run out to less than a pixel."""
    picture = raw_picture(tube_paths(size, oversample=2))
    row, column = np.indices(picture.shape) - (size - 1) / 2
    outside = np.hypot(row, column) > radius * size
    holes = collimator(np.where(outside, np.float32(6), picture))
    assert not (outside & ~holes).any()
    assert holes[~outside].mean() < 0.12


def test_a_dark_round_corner_is_no_round_shutter():
    """What lies beyond the circle of its rim is the picture."""
    size = 384
    picture = raw_picture(tube_paths(size, oversample=2))
    row, column = np.indices(picture.shape)
    corner = np.hypot(row - size, column - size) < 0.3 * size
    holes = collimator(np.where(corner, np.float32(6), picture))
    assert holes[corner].mean() > 0.95
    assert holes[~corner].mean() < 0.05
