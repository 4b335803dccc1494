"""Rims stand out on one side, vessels on both."""

import cv2
import numpy as np
import pytest

from gcar_deploy.imaging import enhance
from gcar_deploy.imaging.one_sided import one_sided

SIDE, PIXEL_MM = 320, 0.3
ROWS, COLUMNS = np.indices((SIDE, SIDE), dtype=np.float32)
NO_HOLES = np.zeros((SIDE, SIDE), bool)
#: both lines lie along columns
RIM, VESSEL = 90, 230


def line_at(column, first=40, last=280):
    line = np.zeros((SIDE, SIDE), bool)
    line[first:last, column] = True
    return line


def scene(noise=0.0, slope=0.0):
    """A vessel 3 mm wide, and a step of the same height whose bright side a rim is drawn along."""
    x = (COLUMNS - VESSEL) * PIXEL_MM
    vessel = 2 * np.sqrt(np.clip(1.5**2 - x**2, 0, None)) / 3
    step = 0.5 - 0.5 * np.tanh((COLUMNS - RIM - 3) / 3.0)
    grain = noise * np.random.default_rng(5).normal(size=ROWS.shape)
    grain = cv2.GaussianBlur(grain, (0, 0), 0.8)
    return np.asarray(vessel + step + slope * ROWS / SIDE + grain, dtype=np.float32)


def found(picture, line, holes=NO_HOLES):
    reach = cv2.dilate(line.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    (rims,) = one_sided([(line, reach)], picture, holes, PIXEL_MM)
    return rims


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("slope", [0.0, 3.0])
def test_the_rim_of_a_shadow_is_told_from_a_vessel(noise, slope):
    picture, both = scene(noise, slope), line_at(RIM) | line_at(VESSEL)
    # Flattened as the ridge filter sees it, the rim is a line like the other.
    flat = enhance.flatten(picture, enhance.FLATTEN_SIGMA_MM / PIXEL_MM)
    response = enhance.ridges(flat, PIXEL_MM).response
    assert response[100:200, RIM - 4 : RIM + 5].max(axis=1).mean() > 0
    np.testing.assert_array_equal(found(picture, both), line_at(RIM))


def test_a_vessel_beside_a_rim_stays_and_short_stretches_are_not_asked():
    near = line_at(RIM + 25)
    x = (COLUMNS - RIM - 25) * PIXEL_MM
    picture = scene() + np.float32(0.7) * np.exp(-0.5 * (x / 0.8) ** 2)
    assert not found(picture, near).any()
    assert not found(scene(), line_at(RIM, 100, 100 + int(5 / PIXEL_MM))).any()


def test_each_stretch_between_forks_is_judged_by_itself():
    line = line_at(RIM)
    line[160, RIM:VESSEL] = True
    line |= line_at(VESSEL)
    picture = scene()
    picture[158:163, RIM + 12 : VESSEL] += 0.8
    told = found(picture, line)
    assert told[50:150, RIM].all() and told[170:270, RIM].all()
    assert not told[:, RIM + 10 :].any()


@pytest.mark.parametrize(("height", "rim"), [(0.25, True), (0.5, True), (1.2, False)])
def test_a_line_on_a_step_is_a_rim_by_its_rise_above_the_higher_side(height, rim):
    """Above a step of height 1 its rise is ``height`` to one side and ``height + 1`` to the other.

    The share is that of the lower rise in their mean: 0.33 and 0.5 lie below the limit, 0.71 above.
    """
    x = (COLUMNS - VESSEL) * PIXEL_MM
    step = (COLUMNS < VESSEL).astype(np.float32)
    picture = step + np.where(np.abs(x) <= 1.2, height + (COLUMNS >= VESSEL), 0)
    assert found(np.asarray(picture, np.float32), line_at(VESSEL)).any() == rim
