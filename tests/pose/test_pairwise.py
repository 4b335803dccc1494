"""A moved patient is found where two views can see the motion, and left alone where not."""

import numpy as np
import pytest

from gcar_deploy.config import PoseOptions, QualityOptions
from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.epipolar import plane_normal
from gcar_deploy.imaging.mask_path import mask_path
from gcar_deploy.pose.landmarks import landmark_pixels
from gcar_deploy.pose.pairwise import Pose, estimate_poses

render = pytest.importorskip("gcar_export.scenes.render", reason="needs the export extra")
from gcar_export.scenes.trees import random_tree  # noqa: E402
from tests.predict.test_hull import carm  # noqa: E402

TOLD = (carm(-30, -20), carm(45, 25))


def pictures(moved=(0.0, 0.0, 0.0), turned=0.0, seed=4, told=TOLD):
    tree = random_tree(np.random.default_rng(seed)).sides("left").segments()
    true = told[1].turned(turned).moved(moved)
    return [
        (told[0], render.path_lengths(told[0], *tree)),
        (told[1], render.path_lengths(true, *tree)),
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


def as_masks(views):
    return [(c, mask_path(path > 0, c.pixel_at_isocenter_mm)) for c, path in views]


@pytest.mark.parametrize("seed", [11, 12, 22, 34])
def test_masks_as_placed_are_left_alone(seed):
    """The profiles alone would move the last two, by 10 and by 3 mm, for what overlaps in them."""
    views = as_masks(pictures(seed=seed))
    pose = estimate_poses(views, PoseOptions(), masks=(True, True))[1]
    assert pose.before > 0.03, "overlaps make the profiles of masks differ"
    assert pose.offset_mm == (0, 0, 0)


def test_a_shift_that_masks_show_is_recovered_and_the_hidden_part_not_invented():
    normal = plane_normal(*TOLD)
    views = as_masks(pictures(moved=6 * normal, seed=11))
    pose = estimate_poses(views, PoseOptions(), masks=(True, True))[1]
    found = np.array(pose.offset_mm)
    assert found @ normal == pytest.approx(6, abs=1)
    assert np.linalg.norm(found - (found @ normal) * normal) < 2


#: pictures of 0.24 mm, whose rays through the pixels' centres miss little of any vessel
FINE = tuple(view.resized(512, 512) for view in TOLD)
SMOOTH = PoseOptions(fine_mm=0.85)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, 5, 6])
@pytest.mark.parametrize("turned", [-2.0, 0.5, 1.0])
def test_calibrated_pictures_show_the_angle(turned, seed):
    """All but the move along the line through both sources is found, to a tenth of a degree."""
    moved = np.array([1.5, -2.0, 3.0])
    views = pictures(moved=moved, turned=turned, seed=seed, told=FINE)
    pose = estimate_poses(views, SMOOTH, calibrated=(True, True))[1]
    assert pose.primary_deg == pytest.approx(turned, abs=0.25)
    assert abs(pose.secondary_deg) < 0.25
    found = pose.applied(FINE[1]).source_mm
    true = FINE[1].turned(turned).moved(moved).source_mm
    base = (found - TOLD[0].source_mm) / np.linalg.norm(found - TOLD[0].source_mm)
    beside = (found - true) - (found - true) @ base * base
    # the source lies 765 mm off: 0.1 deg are 1.3 mm there
    assert np.linalg.norm(beside) < 4.0
    assert pose.after < 0.1 * pose.before


@pytest.mark.parametrize("seed", [4, 5])
def test_noise_of_other_causes_makes_the_prior_strong_again(seed):
    """Calibration that drifts over the picture is not taken for an angle."""
    (a, b) = pictures(seed=seed, told=FINE)
    rows = np.linspace(0.85, 1.15, b[1].shape[0])[:, None].astype(np.float32)
    cols = 1 + 0.1 * np.sin(np.linspace(0, 9, b[1].shape[1]), dtype=np.float32)
    pose = estimate_poses([a, (b[0], b[1] * rows * cols)], SMOOTH, calibrated=(True, True))[1]
    assert pose.turn_deg < 0.7 and pose.shift_mm < 2.0


def test_exact_pictures_are_left_alone():
    pose = estimate_poses(pictures(told=FINE), SMOOTH, calibrated=(True, True))[1]
    assert pose == Pose(before=pose.before, after=pose.before)


def landmarks(moved, count):
    """Pixels of points of the tree in both pictures, as a person would mark them."""
    starts = random_tree(np.random.default_rng(4)).sides("left").segments()[0]
    points = starts[:: len(starts) // count][:count]
    views = TOLD[0], TOLD[1].moved(moved)
    return np.stack([view.project(points)[0] for view in views], axis=1)


def test_a_landmark_decides_where_the_profiles_cannot():
    """The second picture shows another vessel tree, so its mass misleads; the marks do not."""
    normal = plane_normal(*TOLD)
    moved = 6.0 * normal
    (a, b) = pictures(moved=moved)
    path = pictures(seed=5)[1][1]
    marks = landmarks(moved, 3)
    without = estimate_poses([a, (b[0], path)], PoseOptions())[1]
    pose = estimate_poses([a, (b[0], path)], PoseOptions(), marks)[1]
    assert abs(np.dot(without.offset_mm, normal) - 6.0) > 1.0
    # What is missing of the move is in the angles: the marks lie close together.
    assert np.dot(pose.offset_mm, normal) == pytest.approx(6.0, abs=1.0)
    assert pose.landmark_before_mm > 3.0 and pose.landmark_after_mm < 0.9


def test_a_landmark_seen_once_says_nothing():
    marks = landmarks(np.zeros(3), 1)
    marks[0, 0] = np.nan
    pose = estimate_poses(pictures(), PoseOptions(), marks)[1]
    assert pose.landmark_before_mm is None and pose.offset_mm == (0, 0, 0)


def test_landmarks_are_checked():
    mark = ((10.0, 20.0), (30.0, 40.0))
    assert landmark_pixels([mark], TOLD).shape == (1, 2, 2)
    for wrong, words in (
        (((10.0, 20.0),), "1 points for 2 views"),
        (((10.0, 20.0), None), "one view"),
        (((-1.0, 20.0), (30.0, 40.0)), "outside"),
    ):
        with pytest.raises(UsageError, match=words):
            landmark_pixels([wrong], TOLD)
    # The first pixel reaches half of one before its middle, the last half of one behind.
    columns, rows = TOLD[0].columns, TOLD[0].rows
    for inside in ((-0.4, -0.4), (columns - 0.6, rows - 0.6)):
        landmark_pixels([(inside, (1.0, 1.0))], TOLD)
    for beyond in ((-0.6, 1.0), (1.0, -0.6), (columns - 0.4, 1.0), (1.0, rows - 0.4)):
        with pytest.raises(UsageError, match="outside"):
            landmark_pixels([(beyond, (1.0, 1.0))], TOLD)


def test_blank_picture_and_switched_off():
    (a, b) = pictures()
    assert estimate_poses([a, (b[0], np.zeros_like(b[1]))], PoseOptions())[1] == Pose()
    moved = pictures(moved=5 * plane_normal(*TOLD))
    off = estimate_poses(moved, PoseOptions(enabled=False))[1]
    assert off.offset_mm == (0, 0, 0) and off.before > 0.02


def test_a_large_correction_is_said_in_words():
    gates = QualityOptions()
    assert Pose().note("2", 2, gates) is None
    assert Pose(offset_mm=(1.0, 1.0, 1.0), primary_deg=-0.9).note("2", 2, gates) is None
    said = Pose(offset_mm=(2.0, 0.0, -2.0), secondary_deg=0.4).note("b", 2, gates)
    assert said is not None
    assert "view b" in said and "2.8 mm" in said and "0.4 deg" in said
    assert "1.2 deg" in (Pose(primary_deg=-1.2).note("b", 2, gates) or "")


def test_two_views_do_not_see_all_of_a_move_and_say_so_once():
    gates = QualityOptions()
    moved = Pose(offset_mm=(0.0, 0.0, 4.2))
    assert "may not show" in moved.note("2", 2, gates)
    assert "may not show" not in moved.note("2", 3, gates)
    # Beyond the gates a finding says it (``check_poses``).
    for more in (Pose(offset_mm=(0.0, 0.0, 5.2)), Pose(secondary_deg=1.6)):
        assert "may not show" not in more.note("2", 2, gates)
