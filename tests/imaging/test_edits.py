"""What is erased or painted in a picture, each by itself, is what the vessels show."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import ImagingOptions
from gcar_deploy.errors import RefusedError
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.types import Mask

SIDE = 200


@pytest.fixture
def picture() -> Angiogram:
    """A mask of two bars across the picture, 8 pixels wide."""
    pixels = np.zeros((SIDE, SIDE), np.float32)
    pixels[40:48, 20:180] = pixels[140:148, 20:180] = 1
    return Angiogram.without_geometry("1", (pixels, 8, ""), Intensity(kind="mask"), 0.5)


def below() -> Mask:
    half = np.zeros((SIDE, SIDE), bool)
    half[100:] = True
    return half


def test_what_is_erased_alone_holds_no_vessel(picture: Angiogram) -> None:
    plain = extract_vessels(picture, ImagingOptions())
    found = extract_vessels(dataclasses.replace(picture, erased=below()), ImagingOptions())
    assert plain.mask[140:148, 90].all()
    for array in (found.mask, found.skeleton, found.path_mm):
        assert not array[below()].any()
        assert array[~below()].any()
    with pytest.raises(RefusedError, match="erased"):
        extract_vessels(
            dataclasses.replace(picture, erased=np.ones_like(below())), ImagingOptions()
        )


def test_paths_that_a_picture_tells_stay_and_where_it_shows_none_the_width_is_the_path() -> None:
    pixels = np.zeros((SIDE, SIDE), np.float32)
    pixels[40:48, 20:180] = 0.3  # below what is taken for vessel, above noise
    picture = Angiogram.without_geometry(
        "1", (pixels, 16, ""), Intensity(kind="path_length", mm_per_count=1.0), 0.5
    )
    bars = np.zeros((SIDE, SIDE), bool)
    bars[40:48, 20:180] = bars[120:128, 20:180] = True
    found = extract_vessels(dataclasses.replace(picture, painted=bars), ImagingOptions())
    assert found.path_mm[44, 90] == pytest.approx(0.3)
    assert found.path_mm[123:125, 90] == pytest.approx(4.0, rel=0.2)
    assert found.painted is not None and (found.painted == bars).all()


def test_what_is_painted_alone_is_vessel(picture: Angiogram) -> None:
    bar = np.zeros((SIDE, SIDE), bool)
    bar[60:120, 90:98] = True
    found = extract_vessels(dataclasses.replace(picture, painted=bar), ImagingOptions())
    assert found.mask[bar].all()
    # eight pixels of half a millimetre: 4 mm in the middle
    assert found.path_mm[90, 93:95] == pytest.approx(4.0, rel=0.2)
    assert found.mask[140:148, 90].all()
