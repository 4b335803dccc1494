"""A scene in its own terms is the same scene, wherever its origin, whatever its first view."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.own_frame import own_frame


def view(primary: float, secondary: float, **other: object) -> CArm:
    return CArm(
        primary_angle_deg=primary, secondary_angle_deg=secondary, sod_mm=765, sdd_mm=1100,
        rows=512, columns=400, pixel_spacing_mm=(0.39, 0.37), **other,
    )  # fmt: skip


VIEWS = [view(45, 25), view(-30, -20, principal_point_px=(210.3, 250.1)), view(0, 40)]
POINTS = np.random.default_rng(1).uniform(-50, 50, (20, 3))


@pytest.mark.parametrize("shift", [(0, 0, 0), (1e-6, -1e-6, 5e-7), (13.37, -2.21, 80.3)])
@pytest.mark.parametrize("matrix", [False, True])
def test_points_project_where_they_did(shift: tuple[float, ...], matrix: bool) -> None:
    carms = [carm.moved(shift) for carm in VIEWS]
    if matrix:
        carms = [CArm.from_matrix(c.world2pixel, rows=c.rows, columns=c.columns) for c in carms]
    frame = own_frame(carms, "abc")
    assert frame.order == (1, 2, 0)
    np.testing.assert_allclose(frame.origin_mm, -np.array(shift), atol=1e-7)
    for carm in carms:
        own = frame.carm(carm).project(POINTS - frame.origin_mm)
        told = carm.project(POINTS)
        np.testing.assert_allclose(own[0], told[0], atol=1e-4)
        np.testing.assert_allclose(own[1], told[1], atol=1e-4)


def test_a_moved_frame_is_the_same_frame_to_the_last_digit() -> None:
    grid = Grid(center_mm=(1, 2, 3), size_mm=(10, 10, 10), shape=(5, 5, 5))
    base = own_frame(VIEWS, "abc")
    for shift in ((3e-7, -8e-7, 9e-7), (1.37, -2.21, 0.83)):
        carms = [carm.moved(shift) for carm in VIEWS]
        frame = own_frame(carms, "abc")
        assert [frame.carm(c) for c in carms] == [base.carm(c) for c in VIEWS]
        center = tuple(float(c - s) for c, s in zip(grid.center_mm, shift, strict=True))
        assert frame.grid(dataclasses.replace(grid, center_mm=center)) == base.grid(grid)


def test_views_of_equal_angles_stand_in_the_order_of_their_pictures() -> None:
    twins = [view(45, 25), view(45.0000001, 25), view(-30, 0)]
    assert own_frame(twins, ["b", "a", "c"]).order == (2, 1, 0)
    assert own_frame(twins[::-1], ["c", "a", "b"]).order == (0, 1, 2)


@pytest.mark.parametrize("factor", [1.0, -1.0, 1e-7, 1e3])
@pytest.mark.parametrize("shift", [(0, 0, 0), (13.37, -2.21, 80.3)])
def test_a_view_told_by_its_matrix_is_the_view_told_by_angles(factor, shift) -> None:
    views = [carm.moved(shift) for carm in VIEWS]
    base = own_frame(views, "abc")
    told = [CArm.from_matrix(factor * c.world2pixel, rows=c.rows, columns=c.columns) for c in views]
    both = [
        dataclasses.replace(c, projection_matrix=tuple(map(tuple, (factor * c.world2pixel))))
        for c in views
    ]
    for carms in (told, both):
        frame = own_frame(carms, "abc")
        assert [frame.carm(c) for c in carms] == [base.carm(c) for c in views]


@pytest.mark.parametrize("pitch", [0.02, 0.021, 9.9, 10.0])
def test_views_of_the_finest_and_the_widest_pixels_have_a_frame(pitch: float) -> None:
    carms = [dataclasses.replace(carm, pixel_spacing_mm=(pitch, pitch)) for carm in VIEWS[::2]]
    carms = [dataclasses.replace(carm, sdd_mm=771.2345678 if pitch > 1 else 1800) for carm in carms]
    frame = own_frame(carms, "ab")
    for carm in carms:
        own = frame.carm(carm).project(POINTS - frame.origin_mm)
        np.testing.assert_allclose(own[0], carm.project(POINTS)[0], rtol=1e-6, atol=1e-4)


def at(*angles: tuple[float, float]) -> list[CArm]:
    return [view(*pair) for pair in angles]


def test_one_direction_called_180_and_minus_180_has_one_place() -> None:
    for there in (95.0, -95.0, 10.0):
        orders = {own_frame(at((there, 5), (a, 20)), "ab").order for a in (180.0, -180.0)}
        assert len(orders) == 1


@given(st.floats(-180, 180), st.permutations(range(4)))
def test_a_turned_scene_keeps_the_order_of_its_views(turn: float, order: list[int]) -> None:
    angles = [(-60.0, 5.0), (-20.0, 30.0), (-20.0, -25.0), (70.0, 0.0)]
    told = [((angles[k][0] + turn + 180) % 360 - 180, angles[k][1]) for k in order]
    found = own_frame(at(*told), [str(k) for k in order]).order
    assert [order[k] for k in found] == [0, 2, 1, 3]


def test_the_last_digit_of_equal_angles_puts_no_view_first() -> None:
    for angle in (10.005, 0.0, 180.0):
        for off in (-1e-9, 0.0, 1e-9):
            told = at((angle, 42.8), (min(angle + off, 180.0), -42.8))
            assert own_frame(told, "ab").order == (1, 0)
