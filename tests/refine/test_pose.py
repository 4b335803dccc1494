"""A moved patient is found where two views can see the motion, and left alone where not."""

import numpy as np
import pytest

from gcar_deploy.config import PoseOptions
from gcar_deploy.geometry.epipolar import plane_normal
from gcar_deploy.refine.pose import Pose, estimate_poses

render = pytest.importorskip("gcar_export.render", reason="needs the export extra")
from gcar_export.trees import random_tree  # noqa: E402
from tests.predict.test_candidates import carm  # noqa: E402

TOLD = (carm(-30, -20), carm(45, 25))


def pictures(moved=(0.0, 0.0, 0.0), turned=0.0, seed=4):
    tree = random_tree(np.random.default_rng(seed)).sides("left").segments()
    true = TOLD[1].turned(turned).moved(moved)
    return [
        (TOLD[0], render.path_lengths(TOLD[0], *tree)),
        (TOLD[1], render.path_lengths(true, *tree)),
    ]


def test_nothing_is_corrected_where_nothing_is_wrong():
    pose = estimate_poses(pictures(), PoseOptions())[1]
    assert pose.offset_mm == (0, 0, 0) and pose.primary_deg == 0
    assert pose.applied(TOLD[1]) is TOLD[1]


@pytest.mark.parametrize("seed", [4, 5, 6])
@pytest.mark.parametrize("shift", [-6.0, -2.0, 3.0, 8.0])
def test_visible_shift_is_recovered(shift, seed):
    normal = plane_normal(*TOLD)
    pose = estimate_poses(pictures(moved=shift * normal, seed=seed), PoseOptions())[1]
    assert np.dot(pose.offset_mm, normal) == pytest.approx(shift, abs=0.5)
    assert pose.after < 0.6 * pose.before


def test_hidden_shift_is_not_invented():
    normal = plane_normal(*TOLD)
    across = np.cross(normal, TOLD[1].axes[2])
    pose = estimate_poses(pictures(moved=4 * across), PoseOptions())[1]
    assert np.linalg.norm(pose.offset_mm) < 1.5


def test_shift_with_an_angle_error_as_in_a_room():
    normal = plane_normal(*TOLD)
    moved = np.array([1.5, -2.0, 3.0])
    pose = estimate_poses(pictures(moved=moved, turned=1.0), PoseOptions())[1]
    assert np.dot(pose.offset_mm, normal) == pytest.approx(moved @ normal, abs=0.6)


def test_blank_picture_and_switched_off():
    (a, b) = pictures()
    assert estimate_poses([a, (b[0], np.zeros_like(b[1]))], PoseOptions())[1] == Pose()
    moved = pictures(moved=5 * plane_normal(*TOLD))
    off = estimate_poses(moved, PoseOptions(enabled=False))[1]
    assert off.offset_mm == (0, 0, 0) and off.before > 0.02
