"""What stood in the picture before contrast came leaves the vessels; nothing else does."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from skimage.morphology import skeletonize

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.segment import segment
from gcar_deploy.imaging.skeleton import mostly
from gcar_deploy.imaging.standing import what_came, without_standing

SIDE = 352
VESSELS = [
    [(150, 60), (170, 140), (160, 220), (190, 320)],
    [(168, 130), (230, 170), (300, 200)],
    [(162, 200), (100, 250), (60, 310)],
]
CATHETER = [(10, 20), (60, 22), (110, 36), (150, 60)]
LEAD = [(20, 180), (120, 170), (240, 120), (330, 100)]  # across the first two vessels


def _drawn(*lines, shift=(0, 0), seed=None):
    out = np.zeros((SIDE, SIDE), np.float32)
    for line in lines:
        cv2.polylines(out, [np.array(line, np.int32) + shift], False, 1.0, 5, cv2.LINE_AA)
    out = cv2.GaussianBlur(out, (0, 0), 1.0)
    return out if seed is None else _noisy(out, seed)


def _noisy(picture, seed):
    return (picture + 0.03 * np.random.default_rng(seed).normal(size=picture.shape)).astype("f4")


def _found(*lines):
    """All lines as somebody found them, each its own way."""
    mask = _drawn(*lines) > 0.4
    carm = CArm(
        primary_angle_deg=0.0, secondary_angle_deg=0.0, sod_mm=750.0, sdd_mm=1000.0, rows=SIDE,
        columns=SIDE, pixel_spacing_mm=(0.55, 0.55),
    )  # fmt: skip
    return VesselImage(
        view_id="1", carm=carm, path_mm=np.where(mask, np.float32(2), np.float32(0)),
        path_error=0.2, mask=mask, skeleton=skeletonize(mask), valid=np.ones_like(mask), kind="raw",
    )  # fmt: skip


def _share(view, lines):
    on = np.zeros((SIDE, SIDE), np.uint8)
    for line in lines:
        cv2.polylines(on, [np.array(line, np.int32)], False, 1, 1)
    near = cv2.dilate(view.skeleton.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return float(near[on > 0].mean())


@pytest.mark.parametrize("shift", [(0, 0), (5, -6), (-7, 3)])
def test_catheter_and_lead_go_and_the_vessels_they_cross_stay(shift):
    found = _found(*VESSELS, CATHETER, LEAD)
    now = _drawn(*VESSELS, CATHETER, LEAD, seed=0)
    before = [_drawn(CATHETER, LEAD, shift=shift, seed=1), _drawn(CATHETER, LEAD, seed=2)]
    if shift != (0, 0):
        before = before[:1]
    left = without_standing(found, now, before, ~found.valid)
    assert _share(found, [CATHETER, LEAD]) > 0.95
    assert _share(left, VESSELS) > 0.93
    assert _share(left, [CATHETER]) < 0.25
    assert _share(left, [LEAD]) < 0.3
    assert left.catheter is not None and left.catheter_mm > 100
    assert not (left.catheter & left.mask).any()
    assert not left.path_mm[left.catheter].any()


def test_what_each_method_saw_loses_them_too():
    one = _found(*VESSELS, LEAD)
    found = dataclasses.replace(_found(*VESSELS, CATHETER, LEAD), others=(one,))
    now, before = _drawn(*VESSELS, CATHETER, LEAD, seed=0), [_drawn(CATHETER, LEAD, seed=1)]
    left = without_standing(found, now, before, ~found.valid)
    assert _share(left.others[0], [LEAD]) < 0.3 and _share(left.others[0], VESSELS) > 0.93


def test_nothing_goes_where_nothing_stood():
    found = _found(*VESSELS, LEAD)
    before = [_noisy(np.zeros((SIDE, SIDE), np.float32), 4)]
    assert without_standing(found, _drawn(*VESSELS, LEAD, seed=0), before, ~found.valid) is found


def test_a_line_elsewhere_or_of_another_course_is_another():
    found = _found(*VESSELS)
    far = [_drawn(*VESSELS, shift=(30, 0), seed=1), _drawn(CATHETER, seed=2)]
    left = without_standing(found, _drawn(*VESSELS, seed=0), far, ~found.valid)
    assert _share(left, VESSELS) > 0.88


def test_frames_that_were_filled_already_are_not_believed():
    found = _found(*VESSELS, LEAD)
    now = _drawn(*VESSELS, LEAD, seed=0)
    assert without_standing(found, now, [now], ~found.valid) is found


def test_what_came_is_the_vessels_and_not_what_stood_near():
    now = _drawn(*VESSELS, CATHETER, LEAD, seed=0)
    holes = np.zeros(now.shape, bool)
    came = what_came(now, [_drawn(CATHETER, LEAD, shift=(4, -5), seed=1)], holes) > 0
    vessel = _found(*VESSELS).skeleton & ~(_drawn(CATHETER, LEAD, shift=(4, -5)) > 0.05)
    far = cv2.dilate((_drawn(CATHETER, LEAD) > 0.05).astype(np.uint8), np.ones((25, 25))) == 0
    assert came[vessel & far].mean() > 0.97
    assert came[_found(CATHETER, LEAD).skeleton].mean() < 0.05


def test_most_of_a_line_decides_for_all_of_it():
    line, inside = np.zeros((2, 60, 120), bool)
    line[30, 5:115] = True
    inside[:, :60] = True
    inside[30, 20:110:9] = ~inside[30, 20:110:9]  # here and there it is the other way
    most = mostly(line, inside)
    assert most[30, 5:55].all() and not most[30, 65:115].any() and most.sum() == most[30].sum()


def test_a_vessel_with_the_course_of_a_catheter_stays_where_it_came_with_contrast():
    """An even line from the border to a wide vessel: a catheter, unless it was not there before."""
    picture = _drawn(CATHETER)
    for line in VESSELS:
        cv2.polylines(picture, [np.array(line, np.int32)], False, 1.6, 10, cv2.LINE_AA)
    picture = _noisy(cv2.GaussianBlur(picture, (0, 0), 1.5), 0)
    holes = np.zeros(picture.shape, bool)
    on = _drawn(CATHETER) > 0.5
    taken = segment(picture, holes, 0.41)
    assert taken.catheter[on].mean() > 0.5
    empty = [_noisy(np.zeros_like(picture), 5)]
    kept = segment(picture, holes, 0.41, what_came(picture, empty, holes))
    assert kept.catheter[on].mean() < 0.05 and kept.mask[on].mean() > 0.5
    stood = [_drawn(CATHETER, seed=6)]
    still = segment(picture, holes, 0.41, what_came(picture, stood, holes))
    assert still.catheter[on].mean() > 0.5
