"""Frontier points of masks and raw pictures tell where a view stands, and of a heart that moved."""

import dataclasses
import hashlib

import numpy as np
import pytest

from gcar_deploy.config import PoseOptions, RunOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import plane_normal, plane_slices, ray_gaps
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.pose.agreement import poses_between, with_motion
from gcar_deploy.pose.frontier import (
    RAW_MM,
    _Match,
    agree_at_frontiers,
    by_frontiers,
    frontier_points,
)
from gcar_deploy.pose.pairwise import Pose
from gcar_deploy.quality import check_motion

render = pytest.importorskip("gcar_export.scenes.render", reason="needs the export extra")
from gcar_export.scenes.motion import heart_motion, moved_tree  # noqa: E402
from gcar_export.scenes.trees import random_tree  # noqa: E402

OPTIONS = RunOptions()


def carm(a, b):
    return CArm(
        primary_angle_deg=a, secondary_angle_deg=b, sod_mm=765, sdd_mm=1100, rows=384, columns=384,
        pixel_spacing_mm=(0.5, 0.5),
    )  # fmt: skip


TOLD = (carm(-35, -20), carm(40, 25))
NORMAL = plane_normal(*TOLD)


def trees(rms_mm, shift_mm=0.0, seed=4):
    """Return a tree, and the same after a motion of so many mm and a shift across the planes."""
    rng = np.random.default_rng(seed)
    tree = random_tree(rng).sides("left")
    points = np.concatenate([v.points_mm for v in tree.vessels])
    moved = moved_tree(tree, heart_motion(rng, points, rms_mm), np.eye(3))
    vessels = tuple(
        dataclasses.replace(v, points_mm=v.points_mm + shift_mm * NORMAL) for v in moved.vessels
    )
    return tree, dataclasses.replace(moved, vessels=vessels)


def masks(pair):
    out = []
    for k, (view, tree) in enumerate(zip(TOLD, pair, strict=True)):
        pixels = np.float32(255) * (render.path_lengths(view, *tree.segments()) > 0.3)
        shown = Angiogram(
            view_id=str(k + 1), carm=view, pixels=pixels.astype(np.float32), bit_depth=8,
            intensity=Intensity(kind="mask", polarity="bright", mm_per_count=None),
            sha256=hashlib.sha256(pixels.tobytes()).hexdigest(),
        )  # fmt: skip
        out.append(extract_vessels(shown, OPTIONS.imaging, None))
    return out


def gap_mm(pair, pose):
    """Return how far the rays of the same true points pass each other, root mean square."""
    first, second = (np.concatenate([v.points_mm for v in tree.vessels]) for tree in pair)
    pixels = TOLD[1].project(second)[0]
    if pose.motion is not None:
        pixels = pixels + pose.motion.at(TOLD[1], pixels)
    return float(np.sqrt(np.mean(
        ray_gaps(TOLD[0], pose.applied(TOLD[1]), TOLD[0].project(first)[0], pixels) ** 2
    )))  # fmt: skip


def test_points_lie_where_the_outline_touches_its_planes():
    view = masks(trees(0.0))[0]
    points = frontier_points(view, TOLD)
    assert 4 < len(points.pixels) < 60 and set(points.side) == {-1.0, 1.0}
    rows, cols = np.nonzero(view.mask)
    across = plane_slices(*TOLD, view.carm, np.column_stack([cols, rows]).astype(float))[0]
    for (col, row), side in zip(points.pixels, points.side, strict=True):
        assert view.mask[int(row), int(col)]
        own = plane_slices(*TOLD, view.carm, np.array([[col, row]]))[0]
        near = np.maximum(np.abs(cols - col), np.abs(rows - row)) <= 2
        assert (side * across[near] <= side * own + 1e-6).all()


def test_partners_are_of_one_side_and_of_about_one_mass():
    first, second = (frontier_points(view, TOLD) for view in masks(trees(0.0)))
    match = _Match.of(first, second, TOLD, second.pixels)
    same = first.side[:, None] == second.side[None]
    assert ((match.likely > 0) == same).all()
    apart = first.mass[:, None] - second.mass[None]
    apart = np.abs(apart - np.median(first.mass) + np.median(second.mass))[same]
    order = np.argsort(apart)
    assert (np.diff(match.likely[same][order]) <= 1e-9).all()


def test_a_heart_at_rest_is_left_where_it_stands():
    pair = trees(0.0)
    pose = by_frontiers(masks(pair), Pose(), marked=False)
    assert pose.motion is None and pose.left_mm == 0.0 and gap_mm(pair, pose) < 0.1


def test_masks_that_were_shifted_are_placed():
    pair = trees(0.0, shift_mm=2.5)
    views = masks(pair)
    placed = by_frontiers(views, Pose(), marked=False)
    assert placed.motion_mm == 0.0
    assert gap_mm(pair, Pose()) > 2.4 and gap_mm(pair, placed) < 0.1
    # What a person marked is not overruled.
    assert by_frontiers(views, Pose(), marked=True) == Pose()
    off = dataclasses.replace(OPTIONS, pose=PoseOptions(enabled=False))
    assert with_motion(views, (Pose(), Pose()), off) == (Pose(), Pose())


@pytest.mark.parametrize("seed", [4, 7])
def test_masks_of_a_heart_that_moved_say_so(seed):
    pair = trees(3.0, seed=seed)
    views = masks(pair)
    poses = with_motion(views, poses_between(views, OPTIONS), OPTIONS)
    told = [(p.motion_mm, p.motion is not None, p.after) for p in poses]
    assert 0.3 <= poses[1].motion_mm < 3.0
    assert check_motion(views, told, OPTIONS.quality)
    if poses[1].motion is not None:
        assert gap_mm(pair, poses[1]) < 0.7 * gap_mm(pair, Pose())


@pytest.mark.parametrize("rms_mm", [0.0, 2.0])
def test_raw_pictures_are_told_of_and_never_bent(rms_mm):
    views = [dataclasses.replace(view, kind="raw") for view in masks(trees(rms_mm))]
    pose = by_frontiers(views, Pose(), marked=False)
    assert pose.motion is None and not pose.theta.any()
    assert pose.left_mm > RAW_MM if rms_mm else pose.left_mm == 0.0


def test_too_few_points_tell_nothing():
    view, other = masks(trees(0.0))
    empty = dataclasses.replace(other, mask=np.zeros_like(other.mask))
    assert agree_at_frontiers(view, empty, np.zeros(5)) is None
    assert by_frontiers((view, empty), Pose(), marked=False) == Pose()
