"""Which lines of a picture may be something else than vessel, and what is left without them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.skeleton import skeletonize
from gcar_deploy.imaging.stray_lines import (
    comes_from_outside,
    lost_lines,
    shows_device,
    stray_lines,
    with_line,
    without_line,
)
from gcar_deploy.types import Mask
from tests.imaging.phantoms import PIXEL_MM, carm

SIDE = 240


def view_of(*strokes: tuple[slice, slice]) -> VesselImage:
    mask = np.zeros((SIDE, SIDE), bool)
    for rows, columns in strokes:
        mask[rows, columns] = True
    return VesselImage(
        view_id="1", carm=carm(SIDE, SIDE), path_mm=mask.astype(np.float32), path_error=0.25,
        mask=mask, skeleton=skeletonize(mask), valid=np.ones(mask.shape, bool), kind="raw",
    )  # fmt: skip


#: strokes 5 pixels wide: a vessel upright in the middle, a line that comes from the left border and
#: crosses it, a branch that ends in the field, and a short bar apart from all
MIDDLE = SIDE // 2
VESSEL = slice(30, SIDE - 30), slice(MIDDLE - 2, MIDDLE + 3)
CROSSING = slice(60, 65), slice(0, SIDE - 40)
BRANCH = slice(SIDE - 65, SIDE - 60), slice(MIDDLE, SIDE - 40)
APART = slice(SIDE - 45, SIDE - 40), slice(40, 40 + round(12 / PIXEL_MM))


def covers(line: Mask, stroke: tuple[slice, slice]) -> float:
    """Share of a stroke's columns that a line runs through."""
    inside = line[stroke].any(axis=0)
    return float(inside.mean())


def test_what_comes_from_the_border_goes_on_straight_through_the_vessel() -> None:
    view = view_of(VESSEL, CROSSING)
    lines = list(stray_lines(view))
    assert len(lines) == 2
    short, long = sorted(lines, key=np.sum)
    assert not (short & ~view.skeleton).any() and not (long & ~view.skeleton).any()
    assert covers(short, CROSSING) == pytest.approx(MIDDLE / (SIDE - 40), abs=0.03)
    assert covers(long, CROSSING) > 0.97
    # neither takes the vessel along
    assert not long[90:, :].any() and not long[:50, :].any()


def test_a_branch_that_ends_in_the_field_is_never_asked() -> None:
    assert list(stray_lines(view_of(VESSEL, BRANCH))) == []


def test_what_stands_apart_is_asked_unless_it_is_the_largest() -> None:
    (line,) = stray_lines(view_of(VESSEL, APART))
    assert covers(line, APART) > 0.8 and not line[VESSEL].any()


def test_without_the_line_its_vessel_is_whole() -> None:
    view = view_of(VESSEL, CROSSING)
    line = max(stray_lines(view), key=np.sum)
    left = without_line(view, line)
    assert left is not None and left.catheter is not None
    far = np.abs(np.arange(view.mask.shape[1]) - MIDDLE) > 8
    assert not left.mask[CROSSING][:, far[: SIDE - 40]].any()
    assert not left.path_mm[~left.mask].any()
    assert left.mask[VESSEL].mean() > 0.95
    assert left.catheter[62, 20] and not left.catheter[100, MIDDLE]
    assert without_line(view, view.skeleton) is None


def test_what_goes_on_from_a_device_that_was_left_out_is_asked() -> None:
    """The branch ends in the field; a device goes on from there, or lies elsewhere."""
    view = view_of(VESSEL, BRANCH)
    beyond, elsewhere = np.zeros((2, SIDE, SIDE), bool)
    beyond[BRANCH[0], SIDE - 38 :] = True
    elsewhere[60:65, SIDE - 38 :] = True
    assert list(stray_lines(dataclasses.replace(view, catheter=elsewhere))) == []
    line = next(stray_lines(dataclasses.replace(view, catheter=beyond)))
    assert covers(line, BRANCH) > 0.9 and not line[:100].any()


@pytest.mark.parametrize(("half", "asked"), [(2, True), (5, False)])
def test_what_is_wider_than_the_device_before_it_is_the_vessel_that_it_fills(
    half: int, asked: bool
) -> None:
    """A catheter from the right, 5 pixels wide, and on from its tip a line as wide, or wider."""
    tip = SIDE - 40
    catheter = BRANCH[0], slice(tip, SIDE)
    vessel = slice(BRANCH[0].start + 2 - half, BRANCH[0].start + 3 + half), slice(MIDDLE, tip)
    whole = view_of(VESSEL, vessel, catheter)
    view, device = view_of(VESSEL, vessel), np.zeros((SIDE, SIDE), bool)
    device[catheter] = True
    view = dataclasses.replace(view, catheter=device, kept=lambda: whole)
    assert bool(list(stray_lines(view))) is asked


@pytest.mark.parametrize(("half", "found"), [(2, False), (5, True)])
def test_a_catheter_is_asked_to_where_the_vessel_that_it_fills_is_wider(
    half: int, found: bool
) -> None:
    """From the left border a line 5 pixels wide, and on from its tip one as wide, or wider."""
    tip = 60
    catheter = BRANCH[0], slice(0, tip)
    vessel = slice(BRANCH[0].start + 2 - half, BRANCH[0].start + 3 + half), slice(tip, MIDDLE)
    lines = list(stray_lines(view_of(VESSEL, catheter, vessel)))
    ends = sorted(int(np.argwhere(line.any(axis=0)).max()) for line in lines)
    assert ends[-1] > MIDDLE - 8
    assert any(abs(end - tip) <= 6 for end in ends) is found


def test_a_device_from_outside_is_told_from_one_within() -> None:
    device = np.zeros((SIDE, SIDE), bool)
    view = view_of(VESSEL)
    assert not shows_device(view)
    device[60:65, 40:80] = True
    assert not shows_device(dataclasses.replace(view, catheter=device))
    device[60:65, :40] = True
    assert shows_device(dataclasses.replace(view, catheter=device))


def test_what_there_is_with_devices_is_made_once_however_often_it_is_asked_for() -> None:
    asked: list[VesselImage] = []

    def kept() -> VesselImage:
        asked.append(view_of(VESSEL, CROSSING))
        return asked[-1]

    view = dataclasses.replace(view_of(VESSEL), kept=kept)
    again = dataclasses.replace(view, catheter_mm=1.0)
    assert view.kept is not None and again.kept is not None
    assert view.kept() is again.kept() is view.kept()
    assert len(asked) == 1


def test_a_line_from_outside_is_one_that_reaches_the_border() -> None:
    view = view_of(VESSEL, CROSSING)
    assert comes_from_outside(view, view_of(CROSSING).skeleton)
    assert not comes_from_outside(view, view_of(BRANCH).skeleton)


def test_a_line_that_comes_back_leaves_nothing_of_its_device() -> None:
    """Two lines were taken for devices, wider than they are; one comes back."""
    whole = view_of(VESSEL, BRANCH, APART)
    view = view_of((VESSEL[0], VESSEL[1]))
    device = np.zeros((SIDE, SIDE), bool)
    for rows, columns in (BRANCH, APART):
        device[rows.start - 3 : rows.stop + 3, columns] = True
    device[20:24, 200:204] = True  # a speck that is no line
    view = dataclasses.replace(view, catheter=device & ~view.mask)
    apart, branch = sorted(lost_lines(view, whole), key=np.sum)
    assert covers(branch, BRANCH) > 0.8 and covers(apart, APART) > 0.7
    assert not (branch & view.mask).any()
    back = with_line(view, whole, branch)
    assert back.mask[BRANCH].all() and not back.mask[APART].any()
    assert back.path_mm[BRANCH].all() and not back.path_mm[APART].any()
    assert back.catheter is not None and back.catheter[APART].all()
    assert back.catheter[20:24, 200:204].all()
    assert not back.catheter[24 : APART[0].start - 3].any()
