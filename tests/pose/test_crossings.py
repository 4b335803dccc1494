"""A vessel crosses the epipolar planes as often in one view as in the other, however it is drawn.

The curves are projected point by point and drawn by OpenCV; no picture is made by the code here.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.pose.crossings import Surplus

FIRST = CArm(
    primary_angle_deg=-30, secondary_angle_deg=20, sod_mm=750, sdd_mm=1000, rows=400, columns=400,
    pixel_spacing_mm=(0.4, 0.4),
)  # fmt: skip
SECOND = dataclasses.replace(
    FIRST, primary_angle_deg=45, secondary_angle_deg=-25, sod_mm=700, rows=360, columns=480
)
T = np.linspace(0.0, 1.0, 400)[:, None]
#: two vessels in space, mm: one that turns in all directions, one that runs down beside it
WINDING = np.hstack([30 * np.cos(4 * T), 25 * np.sin(3 * T), 70 * T - 35])
BESIDE = np.hstack([10 + 15 * T, -20 + 30 * T**2, 30 - 55 * T])


def drawn(carm: CArm, *curves: np.ndarray) -> np.ndarray:
    """Lines one pixel wide where curves fall in a view."""
    picture = np.zeros((carm.rows, carm.columns), np.uint8)
    for curve in curves:
        pixels = np.rint(carm.project(curve)[0]).astype(np.int32)
        cv2.polylines(picture, [pixels[:, None]], False, 1)
    return picture > 0


@pytest.mark.parametrize("carms", [(FIRST, SECOND), (SECOND, FIRST)])
def test_what_both_views_show_is_no_surplus_and_what_one_shows_is(carms) -> None:
    one, two = carms
    both = Surplus(drawn(one, WINDING, BESIDE), one, drawn(two, WINDING, BESIDE), two)
    alone = Surplus(drawn(one, WINDING, BESIDE), one, drawn(two, BESIDE), two)
    assert both.share(drawn(one, WINDING)) < -0.85
    assert both.share(drawn(one, BESIDE)) < -0.85
    assert alone.share(drawn(one, WINDING)) > 0.85


def test_a_line_along_the_planes_says_nothing() -> None:
    """Between views at one height that turn about the body, planes are nearly rows."""
    one = dataclasses.replace(FIRST, secondary_angle_deg=0.0)
    two = dataclasses.replace(FIRST, primary_angle_deg=60, secondary_angle_deg=0.0)
    level = np.hstack([60 * T - 30, 0 * T, 0 * T])
    upright = np.hstack([0 * T, 0 * T, 60 * T - 30])
    surplus = Surplus(drawn(one, level, upright), one, drawn(two, upright), two)
    assert abs(surplus.share(drawn(one, level))) < 0.2
    assert surplus.share(drawn(one, upright)) < -0.85


def test_a_diagonal_counts_as_its_ends_say() -> None:
    """A staircase, a diagonal and a curve with corners between the same planes cross each once."""
    one = dataclasses.replace(FIRST, secondary_angle_deg=0.0)
    two = dataclasses.replace(FIRST, primary_angle_deg=60, secondary_angle_deg=0.0)
    nothing = np.zeros((two.rows, two.columns), bool)
    straight, stairs = np.zeros((2, one.rows, one.columns), bool)
    k = np.arange(150, 250)
    straight[k, k] = True
    stairs[k, k] = stairs[k[:-1], k[1:]] = True
    views = [Surplus(line, one, nothing, two).share(line) for line in (straight, stairs)]
    # All is surplus; the little that hides a short line is the same for lines as long.
    assert views[0] == pytest.approx(views[1], abs=0.01)
    assert 0.8 < views[0] < 1.0
