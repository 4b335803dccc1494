"""Large pictures are searched with fewer pixels: the same place, the same vessels, every pixel."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import ImagingOptions
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.coarse import as_fine, coarser
from gcar_deploy.imaging.extract import extract_vessels
from tests.imaging.phantoms import angiogram, carm, dice, raw_picture, tube_paths

#: of the large pictures, at the isocentre
FINE_MM = 0.1


@pytest.mark.parametrize(
    ("shape", "searched"),
    [((1024, 1024), (512, 512)), ((1101, 1025), (550, 512)), ((2048, 600), (512, 150))],
)
def test_points_fall_on_the_same_place_of_the_coarser_picture(shape, searched) -> None:
    large = angiogram(np.random.default_rng(0).random(shape), pixel_mm=FINE_MM)
    small = coarser(large)
    assert small.pixels.shape == (small.carm.rows, small.carm.columns) == searched
    assert small.pixels.mean() == pytest.approx(large.pixels.mean(), rel=1e-3)
    points = np.random.default_rng(1).uniform(-20, 20, (9, 3))
    fine, coarse = large.carm.project(points)[0], small.carm.project(points)[0]
    factor = np.array(shape[::-1]) / searched[::-1]
    np.testing.assert_allclose(coarse, (fine + 0.5) / factor - 0.5, atol=1e-6)


def test_pictures_of_less_than_twice_the_side_are_searched_as_they_are() -> None:
    own = angiogram(np.random.default_rng(0).random((700, 1023)))
    assert coarser(own) is own


def test_what_is_found_keeps_area_mass_and_line_on_the_finer_pixels() -> None:
    true = tube_paths(1024, pixel_mm=FINE_MM, oversample=2)
    path = tube_paths(512, pixel_mm=2 * FINE_MM)
    skeleton = np.zeros(path.shape, bool)
    other = VesselImage(
        view_id="2", carm=carm(512, 512, 2 * FINE_MM), path_mm=path, path_error=0.15,
        mask=path > 0.2, skeleton=skeleton, valid=np.ones_like(skeleton), kind="raw",
    )  # fmt: skip
    small = dataclasses.replace(
        other, catheter=np.roll(other.mask, 9, 0), others=(other,), kept=lambda: other
    )
    large = angiogram(true, pixel_mm=FINE_MM)
    found = as_fine(small, large)
    assert found.carm == large.carm and found.valid.all()
    assert dice(found.mask, true > 0.2) > 0.97
    mass = float(path.sum()) * (2 * FINE_MM) ** 2
    assert float(found.path_mm.sum()) * FINE_MM**2 == pytest.approx(mass, rel=2e-3)
    # Nearest pixels would be off by 0.08 mm.
    assert np.abs(found.path_mm - true)[true > 0].mean() < 0.06
    # One line on the axes of the three tubes, which are 1168 pixels long where diagonals count one.
    assert true[found.skeleton].min() > 2.5
    assert found.skeleton.sum() == pytest.approx(1168, rel=0.05)
    assert not (found.catheter & found.mask).any()
    assert found.kept is not None
    for one in (*found.others, found.kept()):
        np.testing.assert_array_equal(one.mask, found.mask)


def test_large_raw_pictures_give_the_vessels_on_their_own_pixels() -> None:
    true = tube_paths(1100, pixel_mm=FINE_MM, oversample=2)
    picture = angiogram(raw_picture(true, noise=4.0), pixel_mm=FINE_MM)
    erased = np.zeros(true.shape, bool)
    erased[:300] = True
    found = extract_vessels(picture, ImagingOptions())
    assert found.mask.shape == true.shape and found.carm == picture.carm
    assert dice(found.mask, true > 0.3) > 0.9
    drawn = extract_vessels(dataclasses.replace(picture, erased=erased), ImagingOptions())
    assert not drawn.mask[:300].any()
    np.testing.assert_array_equal(drawn.mask[320:], found.mask[320:])
