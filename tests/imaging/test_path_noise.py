"""Vessel in path lengths with noise: how much of it, how much else; no noise, no change."""

from __future__ import annotations

import numpy as np
import pytest

from gcar_deploy.config import ImagingOptions
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.imaging.path_noise import vessels_in_noise
from tests.imaging.phantoms import PIXEL_MM, angiogram, tube_paths

TRUTH = tube_paths(radius_mm=1.0)
ALL = np.ones(TRUTH.shape, bool)
SMALLEST = 0.1 * PIXEL_MM


def noisy(kind: str, level: float) -> np.ndarray:
    rng = np.random.default_rng(8)
    if kind == "quanta":  # of a beam that vessels attenuate by 0.2 per mm
        count = rng.poisson(level * np.exp(-0.2 * TRUTH))
        path = -np.log(np.maximum(count, 1) / level) / 0.2
    else:
        path = TRUTH + rng.normal(0, level, TRUTH.shape)
    return path if kind == "signed" else np.maximum(path, 0)


@pytest.mark.parametrize(
    ("kind", "level"),
    [("cut", 0.02), ("cut", 0.05), ("cut", 0.2), ("signed", 0.2), ("quanta", 1e4), ("quanta", 1e3)],
)
def test_vessels_are_found_and_little_else(kind: str, level: float) -> None:
    found = vessels_in_noise(noisy(kind, level).astype(np.float32), ALL, PIXEL_MM, SMALLEST)
    assert found is not None
    mask, noise = found
    assert mask[TRUTH > 1.0].mean() > 0.995
    # what is added lies on the rim, within the blur
    rim = tube_paths(radius_mm=2.0) > 0
    assert not mask[~rim].any()
    assert mask.sum() < 1.35 * (TRUTH > 0).sum()
    assert noise == pytest.approx(5.0 / np.sqrt(level) if kind == "quanta" else level, rel=0.1)


@pytest.mark.parametrize("level", [0.0, 0.004])
def test_without_noise_to_speak_of_nothing_changes(level: float) -> None:
    path = noisy("cut", level)
    assert vessels_in_noise(path.astype(np.float32), ALL, PIXEL_MM, SMALLEST) is None
    found = extract_vessels(
        angiogram(np.round(path / 0.001), "path_length", mm_per_count=0.001), ImagingOptions()
    )
    assert found.noise_mm == 0.0
    np.testing.assert_array_equal(found.mask, np.round(path / 0.001) * np.float32(0.001) > SMALLEST)


def test_a_picture_full_of_vessels_without_noise_is_no_noise() -> None:
    wide = np.maximum(tube_paths(radius_mm=9.0), tube_paths(radius_mm=9.0).T)
    assert (wide > 0).mean() > 0.3
    assert vessels_in_noise(wide.astype(np.float32), ALL, PIXEL_MM, SMALLEST) is None


def test_noise_alone_holds_no_vessel() -> None:
    noise = np.abs(np.random.default_rng(3).normal(0, 0.1, (256, 256))).astype(np.float32)
    found = vessels_in_noise(noise, ALL, PIXEL_MM, SMALLEST)
    assert found is not None and found[0].mean() < 1e-3


def test_paths_within_keep_their_mean() -> None:
    counts = np.round(noisy("cut", 0.1) / 0.001)
    found = extract_vessels(angiogram(counts, "path_length", mm_per_count=0.001), ImagingOptions())
    assert found.calibrated and found.noise_mm == pytest.approx(0.1, rel=0.1)
    assert found.path_mm.sum() == pytest.approx(TRUTH.sum(), rel=0.05)
    assert found.skeleton.sum() == pytest.approx(
        extract_vessels(
            angiogram(np.round(TRUTH / 0.001), "path_length", mm_per_count=0.001), ImagingOptions()
        ).skeleton.sum(), rel=0.1,
    )  # fmt: skip
