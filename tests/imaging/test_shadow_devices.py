"""A catheter on an even ground is one: nothing else stands there to be told from it."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from gcar_deploy.config import ImagingOptions
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.imaging.net import load_segmenter
from tests.imaging.phantoms import angiogram

SIDE, PIXEL = 512, 0.3


def _curve(corners, count=200):
    """(count, 2) points of a Bezier curve."""
    t, points = np.linspace(0, 1, count)[:, None], np.asarray(corners, float)
    curves = list(points)
    while len(curves) > 1:
        curves = [(1 - t) * a + t * b for a, b in itertools.pairwise(curves)]
    return curves[0]


def _drawn(lines):
    """(SIDE, SIDE) mm: chords of tapered tubes, each of points, first and last radius in mm."""
    out = np.zeros((SIDE * 2, SIDE * 2), np.float32)
    row, col = np.indices(out.shape, dtype=np.float32)
    for points, first, last in lines:
        for (x, y), r in zip(2 * points, np.linspace(first, last, len(points)), strict=True):
            reach = 2 * r / PIXEL
            y0, x0 = max(int(y - reach), 0), max(int(x - reach), 0)
            part = slice(y0, int(y + reach) + 2), slice(x0, int(x + reach) + 2)
            gap = np.hypot(col[part] - x, row[part] - y) / reach
            np.maximum(out[part], 2 * r * np.sqrt(np.clip(1 - gap**2, 0, None)), out=out[part])
    return cv2.resize(out, (SIDE, SIDE), interpolation=cv2.INTER_AREA)


VESSELS = [
    (_curve([(300, 200), (240, 210), (180, 300), (200, 420)], 400), 1.9, 0.8),
    (_curve([(300, 200), (360, 240), (400, 320), (380, 430)], 400), 1.6, 0.6),
    (_curve([(222, 262), (160, 280), (130, 330)]), 0.8, 0.4),
    (_curve([(382, 300), (330, 340), (300, 420)]), 0.7, 0.4),
]
CATHETER = [(_curve([(380, -4), (390, 90), (360, 190), (300, 200)], 400), 1.2, 1.2)]


def _picture(paths, noise):
    grain = np.random.default_rng(3).normal(0, noise, paths.shape)
    grey = 225 * np.exp(-0.13 * cv2.GaussianBlur(paths, (0, 0), 0.8)) + grain
    return np.clip(np.round(grey), 0, 255)


@pytest.fixture(scope="module")
def segmenter():
    return load_segmenter("auto", 1)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.5, 2.0])
def test_the_catheter_goes_and_the_vessels_stay(segmenter, noise):
    vessels, catheter = _drawn(VESSELS), _drawn(CATHETER)
    found = extract_vessels(
        angiogram(_picture(vessels + catheter, noise), pixel_mm=PIXEL), ImagingOptions(), segmenter
    )
    own = cv2.dilate((catheter > 0.2).astype(np.uint8), np.ones((3, 3))) > 0
    away = cv2.dilate((vessels > 0.2).astype(np.uint8), np.ones((15, 15))) == 0
    assert (found.mask & own & away).sum() < 0.1 * (own & away).sum()
    assert found.mask[vessels > 0.5].mean() > 0.9
    assert found.catheter is not None and found.catheter[own & away].mean() > 0.7
    # The views may still bring it back.
    if found.kept is not None:
        assert found.kept().mask[vessels > 0.5].mean() > 0.9


def test_what_does_not_come_from_the_border_is_not_asked():
    def never(*_):
        raise AssertionError("the network was asked")

    class Deaf:
        look = devices = staticmethod(never)

    paths = _drawn(VESSELS)
    found = extract_vessels(
        angiogram(_picture(paths, 0.5), pixel_mm=PIXEL), ImagingOptions(), Deaf()
    )
    assert found.mask[paths > 0.5].mean() > 0.9
    with pytest.raises(AssertionError, match="asked"):
        extract_vessels(
            angiogram(_picture(paths + _drawn(CATHETER), 0.5), pixel_mm=PIXEL),
            ImagingOptions(), Deaf(),
        )  # fmt: skip
