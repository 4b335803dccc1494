"""Contrast as path length: what a display does to it, its scale, and where a vessel ends."""

import numpy as np
import pytest

from gcar_deploy.imaging.contrast import scaled_contrast
from gcar_deploy.imaging.grey_values import bright_vessels
from tests.imaging.phantoms import tube_paths

PIXEL_MM = 0.3


def _contrast(picture, path, support):
    nowhere = np.zeros(path.shape, bool)
    return scaled_contrast(picture, nowhere, support, path * support, PIXEL_MM)


@pytest.mark.parametrize("darkest", [0.0, 0.3, 0.6])
def test_a_vessel_is_as_deep_on_dark_ground_as_on_bright_one(darkest):
    """The window of a display takes so much of the darkest grey value from every pixel."""
    path = tube_paths(radius_mm=1.5)
    ground = np.linspace(0.0, 0.7, path.shape[1])[None, :]
    light = np.exp(-0.1 * path - ground)
    low = darkest * float(light.min())
    shown = np.rint(255 * (light - low) / (light.max() - low))
    pictures, _ = bright_vessels(shown.astype(np.float32), "raw", True)
    found = _contrast(pictures["display"], path, path > 0)
    bright, dark = (
        np.median(found[:, c][path[:, c] > 2] / path[:, c][path[:, c] > 2])
        for c in (slice(45, 75), slice(180, 210))
    )
    assert dark / bright == pytest.approx(1, abs=0.25)
    # The logarithm of the grey value as it is has that for a linear detector alone.
    if darkest == 0.6:
        plain = _contrast(pictures["log"], path, path > 0)
        far = [np.median(plain[:, c][path[:, c] > 2]) for c in (slice(45, 75), slice(180, 210))]
        assert far[1] / far[0] > 1.25


def test_noise_beyond_the_rim_is_no_vessel():
    path = tube_paths(radius_mm=1.5)
    noise = np.random.default_rng(0).normal(0, 0.5, path.shape)
    wide = np.asarray(path > 0) | (np.roll(path, 8, 0) > 0) | (np.roll(path, -8, 0) > 0)
    found = _contrast((path + noise).astype(np.float32), path, wide)
    # 0.4 of the noise's deviation is what cutting at 0 leaves on average: 0.2 mm.
    outside = wide & (path == 0)
    assert found[outside].mean() < 0.1 and (found[path > 1.5] > 0).mean() > 0.98
    assert found[path > 2].mean() == pytest.approx(path[path > 2].mean(), rel=0.1)
    assert not found[~wide].any()


def test_what_has_no_contrast_keeps_what_is_known():
    path = tube_paths()
    flat = np.ones(path.shape, np.float32)
    np.testing.assert_array_equal(_contrast(flat, path, path > 0), path)
