"""What is drawn of two methods' answers: without what one of them knows for a catheter."""

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


def seen(mask, catheter=None):
    return VesselImage(
        view_id="1", carm=CARM, path_mm=2 * mask.astype(np.float32), path_error=0.2, mask=mask,
        skeleton=skeletonize(mask), valid=np.ones_like(mask), kind="raw", catheter=catheter,
    )  # fmt: skip


def test_a_catheter_that_one_method_knows_leaves_mask_and_path():
    shaft = drawn(SHAFT)
    vessel = drawn(VESSEL)
    both = fused(seen(vessel, shaft & ~vessel), seen(shaft | vessel, np.zeros_like(shaft)))
    away = np.hypot(*(np.indices(shaft.shape) - np.array([50, 60])[:, None, None])) > 9
    assert not (both.mask & shaft & away).any() and not (both.path_mm[shaft & away] > 0).any()
    assert (both.mask & vessel)[away].sum() == (vessel & away).sum()
    assert (both.catheter & shaft)[away].sum() == (shaft & away).sum()
    assert not (both.skeleton & ~both.mask).any()
    assert not (both.others[0].mask & shaft & away).any()


def test_a_catheter_that_the_network_knows_leaves_the_classical_path():
    shaft, vessel = drawn(SHAFT), drawn(VESSEL)
    both = fused(seen(shaft | vessel, np.zeros_like(shaft)), seen(vessel, shaft & ~vessel))
    away = np.hypot(*(np.indices(shaft.shape) - np.array([50, 60])[:, None, None])) > 9
    assert (
        not (both.path_mm[shaft & away] > 0).any()
        and not (both.others[1].mask & shaft & away).any()
    )
    assert (both.path_mm[vessel & away] > 0).all()


def test_without_a_catheter_both_paths_are_averaged():
    vessel = drawn(VESSEL)
    none = np.zeros_like(vessel)
    both = fused(seen(vessel, none), seen(drawn(SHAFT) | vessel, none))
    assert both.mask.sum() == (drawn(SHAFT) | vessel).sum()
    assert both.path_mm[100, 60] == pytest.approx(2) and both.path_mm[20, 30] == pytest.approx(1)


def test_a_mask_is_never_emptied():
    vessel = drawn(VESSEL)
    both = fused(seen(drawn(SHAFT), vessel), seen(vessel, np.zeros_like(vessel)))
    assert both.mask.sum() == vessel.sum()
