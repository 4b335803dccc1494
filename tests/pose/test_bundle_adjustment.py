"""Bundle adjustment on curves: with three views a tree tells where each of them stood."""

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import RunOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import triangulate
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.skeleton import skeletonize
from gcar_deploy.pose import bundle_adjustment
from gcar_deploy.pose.bundle_adjustment import adjust
from gcar_deploy.pose.bundling import bundled
from gcar_deploy.pose.joint import corrected
from gcar_deploy.pose.pairwise import Pose
from gcar_deploy.tree.tree import Branch, Tree

render = pytest.importorskip("gcar_export.scenes.render", reason="needs the export extra")
from gcar_export.scenes.trees import random_tree  # noqa: E402

#: the table went by centimetres between the first and the others
MOVED = np.array([[0.0, 0, 0], [12, -18, 6], [-9, 14, -11], [6, 10, 15]])


def carm(primary, secondary):
    return CArm(
        primary_angle_deg=primary, secondary_angle_deg=secondary, sod_mm=765, sdd_mm=1080,
        rows=320, columns=320, pixel_spacing_mm=(0.7, 0.7),
    )  # fmt: skip


TOLD = (carm(-30, -20), carm(45, 25), carm(-10, 35), carm(50, -25))


def scene(count, seed):
    """C-arms as told, what they saw of the moved patient, and the tree."""
    vessels = random_tree(np.random.default_rng(seed)).sides("left")
    views = []
    for told, shift in zip(TOLD[:count], MOVED, strict=False):
        path = render.path_lengths(told.moved(shift), *vessels.segments())
        mask = path > 0.1
        views.append(
            VesselImage(
                view_id="1", carm=told, path_mm=path, path_error=0.25, mask=mask,
                skeleton=skeletonize(mask), valid=np.ones(mask.shape, bool), kind="raw",
            )
        )  # fmt: skip
    return list(TOLD[:count]), views, [v.points_mm for v in vessels.vessels]


def tree_of(lines):
    nodes = np.concatenate([[line[0], line[-1]] for line in lines])
    one = [
        Branch(
            points_mm=line, radius_mm=np.ones(len(line)), sigma_mm=np.ones(len(line)),
            confidence=np.ones(len(line)), start=2 * k, end=2 * k + 1,
        )
        for k, line in enumerate(lines)
    ]  # fmt: skip
    return Tree(nodes_mm=nodes, branches=tuple(one))


def wrong_tree(told, theta, points):
    """The tree as views with corrections ``theta`` would have placed it."""
    seen = [view.moved(shift) for view, shift in zip(told, MOVED, strict=False)]
    placed = [corrected(view, t) for view, t in zip(told, theta, strict=True)]
    return tree_of([triangulate(placed, [view.project(p)[0] for view in seen])[0] for p in points])


def miss_mm(told, theta, points):
    """How far the rays of one point miss each other with these corrections, RMS."""
    seen = [view.moved(shift) for view, shift in zip(told, MOVED, strict=False)]
    placed = [corrected(view, t) for view, t in zip(told, theta, strict=True)]
    p = np.concatenate(points)
    return float(np.sqrt(np.mean(triangulate(placed, [v.project(p)[0] for v in seen])[1] ** 2)))


def off_by(count, mm, seed=0):
    theta = np.zeros((count, 5))
    rng = np.random.default_rng(seed)
    theta[1:, :3] = MOVED[1:count] + rng.normal(0, mm, (count - 1, 3))
    return theta


@pytest.mark.parametrize("count", [3, 4])
def test_views_find_their_place(count):
    told, views, points = scene(count, 4)
    theta = off_by(count, 3.0)
    found = adjust(wrong_tree(told, theta, points), views, told, theta)
    assert found.after_mm < 0.5 * found.before_mm
    assert not found.theta[0].any()
    assert miss_mm(told, theta, points) > 0.7
    assert miss_mm(told, found.theta, points) < 0.45


def test_a_right_pose_stays():
    told, views, points = scene(3, 4)
    theta = off_by(3, 0.0)
    found = adjust(tree_of(points), views, told, theta)
    assert found.before_mm < 0.6 * told[0].pixel_at_isocenter_mm
    assert miss_mm(told, found.theta, points) < 0.45


def test_gaps_in_the_pictures_do_no_harm():
    told, views, points = scene(4, 4)
    rng = np.random.default_rng(1)
    torn = []
    for view in views:
        skeleton = view.skeleton.copy()
        rows, cols = np.nonzero(skeleton)
        for at in rng.integers(0, len(rows), 8):
            skeleton[max(rows[at] - 8, 0) : rows[at] + 8, max(cols[at] - 8, 0) : cols[at] + 8] = 0
        torn.append(dataclasses.replace(view, skeleton=skeleton))
    theta = off_by(4, 3.0)
    found = adjust(wrong_tree(told, theta, points), torn, told, theta)
    assert miss_mm(told, found.theta, points) < 0.6


def test_landmarks_hold_where_the_lines_say_little(monkeypatch):
    told, views, points = scene(3, 4)
    theta = off_by(3, 3.0)
    marks = np.stack([np.concatenate(points)[::60]] * 3, axis=1)
    seen = [view.moved(shift) for view, shift in zip(told, MOVED, strict=False)]
    pixels = np.stack([v.project(marks[:, k])[0] for k, v in enumerate(seen)], axis=1)
    pixels[0, 1] = np.nan  # one point that one view does not show
    monkeypatch.setattr(bundle_adjustment, "LINE_MM", 50.0)
    tree = wrong_tree(told, theta, points)
    alone = adjust(tree, views, told, theta)
    held = adjust(tree, views, told, theta, pixels)
    assert miss_mm(told, held.theta, points) < 0.2 * miss_mm(told, alone.theta, points)


def test_too_little_to_go_by():
    told, views, points = scene(3, 4)
    theta = off_by(3, 3.0)
    short = tree_of([points[0][:5]])
    np.testing.assert_array_equal(adjust(short, views, told, theta).theta, theta)
    blank = [dataclasses.replace(v, skeleton=np.zeros_like(v.skeleton)) for v in views]
    tree = wrong_tree(told, theta, points)
    np.testing.assert_array_equal(adjust(tree, blank, told, theta).theta, theta)


def test_rounds_of_tree_and_poses():
    told, views, points = scene(4, 4)

    def made(placed):
        theta = np.zeros((4, 5))
        theta[:, :3] = [np.subtract(v.carm.isocenter_offset_mm, t.isocenter_offset_mm)
                        for v, t in zip(placed, told, strict=True)]  # fmt: skip
        return wrong_tree(told, theta, points)

    first = tuple(Pose(offset_mm=tuple(t[:3])) for t in off_by(4, 3.0))
    found = bundled(views, first, made, RunOptions())
    assert miss_mm(told, [p.theta for p in found], points) < 0.5
    assert all(p.converged for p in found)

    def never(_):
        raise AssertionError("a tree is made for nothing")

    assert bundled(views[:2], first[:2], never, RunOptions()) == first[:2]
    exact = [dataclasses.replace(view, path_error=0.0) for view in views]
    assert bundled(exact, first, never, RunOptions()) == first
    still = (Pose(),) * 4
    assert bundled(views, still, never, RunOptions()) == still


@pytest.mark.slow
def test_views_that_are_told_rightly_stay():
    """Profiles may agree better elsewhere, but no tree explains as much of the lines there."""
    told, views, points = scene(4, 4)
    right = [carm.moved(shift) for carm, shift in zip(told, MOVED, strict=True)]
    views = [dataclasses.replace(view, carm=c) for view, c in zip(views, right, strict=True)]
    pixels = [[c.project(p)[0] for c in right] for p in points]

    def made(placed):
        carms = [view.carm for view in placed]
        return tree_of([triangulate(carms, seen)[0] for seen in pixels])

    wrong = [Pose(), *(Pose(offset_mm=tuple(4.0 * np.roll([1, -1, 0], k))) for k in range(3))]
    found = bundled(views, wrong, made, RunOptions())
    assert not any(pose.theta.any() for pose in found)
    assert found[1].after == found[1].before

    # who marked points has the say where the views stand
    spots = np.concatenate(points)[::50]
    marks = tuple(tuple(tuple(c.project(spots)[0][k]) for c in right) for k in range(len(spots)))
    assert any(p.theta.any() for p in bundled(views, wrong, made, RunOptions(landmarks=marks)))


@pytest.mark.parametrize(("falls", "settled"), [(0.6, False), (0.95, True)])
def test_rounds_end_at_their_best_or_say_that_they_did_not(monkeypatch, falls, settled):
    """Views that move on along what no line sees have arrived when the tree comes no nearer."""
    _, views, points = scene(3, 4)
    before = [2.0]

    def moved_on(tree, views, told, theta, marks):
        before.append(before[-1] * falls)
        on = theta + np.array([[0.0], [1.0], [1.0]])
        return bundle_adjustment.Adjusted(on, before[-1], 0.1 * before[-1], moving=1.0)

    monkeypatch.setattr("gcar_deploy.pose.bundling.adjust", moved_on)
    monkeypatch.setattr("gcar_deploy.pose.bundling._explained", lambda tree, placed, options: max(
        float(np.abs(np.subtract(v.carm.isocenter_offset_mm, view.carm.isocenter_offset_mm)).max())
        for v, view in zip(placed, views, strict=True)))  # fmt: skip
    first = tuple(Pose(offset_mm=tuple(t[:3])) for t in off_by(3, 0.0))
    found = bundled(views, first, lambda _: tree_of(points), RunOptions())
    assert [pose.converged for pose in found] == [settled] * 3
    assert found[1].offset_mm[0] == pytest.approx(first[1].offset_mm[0] + 4.0)
