"""What is said of a line does not hang on how it is walked or held."""

from __future__ import annotations

import numpy as np
import pytest

from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.line_strips import (
    COURSE,
    MAPS,
    NEAR,
    POINT,
    backwards,
    line_points,
    mirrored,
    near_points,
)
from gcar_deploy.types import Array, Mask

SIDE = 96


def _wave(rows: float = 12.0) -> tuple[Array, Mask]:
    """Maps of noise and one wavy line from border to border, one pixel in each column."""
    rng = np.random.default_rng(5)
    maps = rng.normal(size=(MAPS, SIDE, SIDE)).astype(np.float32)
    maps[4] = 3.0
    line = np.zeros((SIDE, SIDE), bool)
    column = np.arange(SIDE)
    row = np.rint(40 + rows * np.sin(column / 14.0)).astype(int)
    for k in column[1:]:  # no steps of more than one pixel
        row[k] = row[k - 1] + np.clip(row[k] - row[k - 1], -1, 1)
    line[row, column] = True
    return maps, line


def test_a_line_walked_back_is_the_same_line_backwards() -> None:
    maps, line = _wave()
    here = line_points(maps, line, np.zeros_like(line))
    # The picture upside down, left to right: the walk begins at the other end.
    there = line_points(maps[:, ::-1, ::-1], line[::-1, ::-1], np.zeros_like(line))
    assert here is not None and there is not None
    assert here.lengths == there.lengths
    turned = backwards(here.points, here.lengths)
    np.testing.assert_allclose(turned, there.points, atol=2e-3)
    np.testing.assert_array_equal(there.pixels, SIDE - 1 - here.pixels[::-1])


def test_a_line_in_a_mirror_is_mirrored() -> None:
    maps, line = _wave()
    here = line_points(maps, line, np.zeros_like(line))
    there = line_points(maps[:, :, ::-1], line[:, ::-1], np.zeros_like(line))
    assert here is not None and there is not None
    np.testing.assert_allclose(mirrored(here.points), there.points, atol=2e-3)


def test_the_picture_is_sampled_across_the_line() -> None:
    maps = np.zeros((MAPS, SIDE, SIDE), np.float32)
    maps[0] = np.arange(SIDE)[:, None] - 50  # grows by one a row
    line = np.zeros((SIDE, SIDE), bool)
    line[50, 10:80] = True
    found = line_points(maps, line, np.zeros_like(line))
    assert found is not None
    across = found.points[30, : POINT - COURSE].reshape(MAPS, -1)[0]
    np.testing.assert_allclose(np.abs(across), np.abs(np.clip(np.arange(-8, 9), -5, 5)), atol=1e-3)
    assert across[0] == -across[-1]


@pytest.mark.parametrize("radius", [20.0, 40.0])
def test_an_arc_turns_by_its_curvature(radius: float) -> None:
    angle = np.linspace(0, np.pi, 400)
    row, column = (np.rint(48 + radius * f(angle)).astype(int) for f in (np.sin, np.cos))
    line = np.zeros((SIDE, SIDE), bool)
    line[np.minimum(row, SIDE - 1), np.minimum(column, SIDE - 1)] = True
    line = skel.skeletonize(line)
    found = line_points(np.zeros((MAPS, SIDE, SIDE), np.float32), line, np.zeros_like(line))
    assert found is not None
    middle = found.points[sum(found.lengths) // 2, POINT - COURSE :]
    # Eight steps each way, and twenty; a line of pixels is longer than what it stands for.
    assert abs(abs(middle[1]) - 16 / radius) < 0.25 * 16 / radius
    assert abs(abs(middle[2]) - 40 / radius) < 0.2 * 40 / radius


def test_points_are_near_only_on_their_own_line() -> None:
    near = near_points((3, 4))
    assert near.shape == (7, NEAR)
    assert set(near[:3].ravel()) == {0, 1, 2, 7}
    assert set(near[3:].ravel()) == {3, 4, 5, 6, 7}
    np.testing.assert_array_equal(near[4, :5], [7, 3, 4, 5, 6])


def test_short_lines_have_no_course() -> None:
    line = np.zeros((SIDE, SIDE), bool)
    line[50, 10:14] = True
    nothing = np.zeros_like(line)
    for one in (line, nothing):
        assert not len(line_points(np.zeros((MAPS, SIDE, SIDE), np.float32), one, nothing).pixels)
