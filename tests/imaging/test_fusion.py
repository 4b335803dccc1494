"""What is drawn of two methods' answers: without what one of them knows for a catheter."""

import dataclasses

import cv2
import numpy as np
import pytest

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.fusion import fused
from gcar_deploy.imaging.skeleton import skeletonize

SIDE = 128
CARM = CArm(
    primary_angle_deg=0.0, secondary_angle_deg=0.0, sod_mm=750.0, sdd_mm=1000.0, rows=SIDE,
    columns=SIDE, pixel_spacing_mm=(0.4, 0.4),
)  # fmt: skip
SHAFT, VESSEL = ((10, 0), (60, 50)), ((60, 50), (60, 120))


def drawn(*lines, width=5):
    out = np.zeros((SIDE, SIDE), np.uint8)
    for first, last in lines:
        cv2.line(out, first, last, 1, width)
    return out > 0


def picture(*masks):
    """Vessels of 2 mm on a sloping ground, in units of 0.1 per mm."""
    ground = np.add.outer(np.linspace(0, 1, SIDE), np.zeros(SIDE))
    return (ground + 0.2 * np.logical_or.reduce(masks)).astype(np.float32)


def seen(mask, catheter=None):
    return VesselImage(
        view_id="1", carm=CARM, path_mm=2 * mask.astype(np.float32), path_error=0.2, mask=mask,
        skeleton=skeletonize(mask), valid=np.ones_like(mask), kind="raw", catheter=catheter,
    )  # fmt: skip


def test_a_catheter_that_one_method_knows_leaves_mask_and_path():
    shaft = drawn(SHAFT)
    vessel = drawn(VESSEL)
    both = fused(
        seen(vessel, shaft & ~vessel),
        seen(shaft | vessel, np.zeros_like(shaft)),
        picture(shaft, vessel),
    )
    away = np.hypot(*(np.indices(shaft.shape) - np.array([50, 60])[:, None, None])) > 9
    assert not (both.mask & shaft & away).any() and not (both.path_mm[shaft & away] > 0).any()
    assert (both.mask & vessel)[away].sum() == (vessel & away).sum()
    assert (both.catheter & shaft)[away].sum() == (shaft & away).sum()
    assert not (both.skeleton & ~both.mask).any()
    assert not (both.others[0].mask & shaft & away).any()


def test_a_catheter_that_the_network_knows_leaves_the_classical_path():
    shaft, vessel = drawn(SHAFT), drawn(VESSEL)
    both = fused(
        seen(shaft | vessel, np.zeros_like(shaft)), seen(vessel, shaft & ~vessel),
        picture(shaft, vessel),
    )  # fmt: skip
    away = np.hypot(*(np.indices(shaft.shape) - np.array([50, 60])[:, None, None])) > 9
    assert (
        not (both.path_mm[shaft & away] > 0).any()
        and not (both.others[1].mask & shaft & away).any()
    )
    assert (both.path_mm[vessel & away] > 0).all()


@pytest.mark.parametrize(("chance", "stays"), [(0.0, False), (0.3, True)])
def test_a_line_that_is_none_for_the_network_is_another_reading(chance, stays):
    """It ends where a vessel begins, whose probability says nothing of it."""
    edge, vessel = drawn(((5, 100), (55, 100))), drawn(VESSEL)
    probability = np.where(vessel, 0.9, np.where(edge, chance, 0)).astype(np.float32)
    both = fused(
        seen(edge | vessel), dataclasses.replace(seen(vessel), vesselness=probability),
        picture(edge, vessel),
    )  # fmt: skip
    assert (both.path_mm[100, 10:50] > 0).all() == stays == (both.path_mm[100, 10:50] > 0).any()
    assert (both.path_mm[50:115, 60] > 0).all() and both.others[1].mask[100, 30]


def test_what_either_takes_for_a_device_is_remembered():
    shaft, vessel = drawn(SHAFT), drawn(VESSEL)
    none = np.zeros_like(shaft)
    whole = seen(shaft | vessel, none)
    learned = dataclasses.replace(seen(vessel, shaft & ~vessel), kept=lambda: whole)
    both = fused(whole, learned, picture(shaft, vessel))
    assert not both.mask[20, 30] and both.kept().mask[20, 30]
    assert both.kept().path_mm[20, 30] == pytest.approx(2, rel=0.1)
    assert fused(whole, seen(vessel, none), picture(shaft, vessel)).kept is None


def test_paths_are_read_from_contrast_wherever_either_sees_a_vessel():
    vessel, branch = drawn(VESSEL), drawn(SHAFT)
    none = np.zeros_like(vessel)
    both = fused(seen(branch, none), seen(vessel, none), picture(branch, vessel))
    assert both.mask.sum() == vessel.sum() and not both.path_mm[~(vessel | branch)].any()
    # The network knows nothing of the branch: its contrast is that of the vessel.
    assert both.path_mm[100, 60] == pytest.approx(2, rel=0.1)
    assert both.path_mm[20, 30] == pytest.approx(2, rel=0.1)
    # ... and says how deep, not the classical method's paths.
    deep = dataclasses.replace(seen(branch, none), path_mm=9 * branch.astype(np.float32))
    same = fused(deep, seen(vessel, none), picture(branch, vessel))
    np.testing.assert_array_equal(same.path_mm, both.path_mm)


def test_a_branch_of_half_the_contrast_is_half_as_deep():
    vessel, branch = drawn(VESSEL), drawn(SHAFT) & ~drawn(VESSEL)
    none = np.zeros_like(vessel)
    faint = (picture(vessel) + 0.1 * branch).astype(np.float32)
    both = fused(seen(vessel | branch, none), seen(vessel, none), faint)
    assert both.path_mm[20, 30] == pytest.approx(1, rel=0.15)


def test_a_mask_is_never_emptied():
    vessel = drawn(VESSEL)
    both = fused(seen(drawn(SHAFT), vessel), seen(vessel, np.zeros_like(vessel)), picture(vessel))
    assert both.mask.sum() == vessel.sum()


def test_lines_that_stand_out_on_one_side_are_left_out_of_further_readings():
    vessel, rim = drawn(((90, 10), (90, 118))), drawn(((30, 10), (30, 118)))
    step = np.repeat((np.arange(SIDE) < 31)[None], SIDE, axis=0)
    ground = (0.2 * vessel + 0.3 * cv2.GaussianBlur(step.astype(np.float32), (0, 0), 1.0)).astype(
        np.float32
    )
    none = np.zeros_like(vessel)
    both = fused(seen(vessel | rim, none), seen(vessel, none), ground)
    learned, classic, less, learned_less, classic_less = both.others
    assert classic.mask[60, 30] and not classic_less.mask[60, 30] and classic_less.mask[60, 90]
    assert learned_less is learned and both.path_mm[:, :40].any()
    assert not less.path_mm[:, :40].any() and less.path_mm[60, 90] > 0
    assert len(fused(seen(vessel, none), seen(vessel, none), ground).others) == 2
