"""With a third view, a move hidden from one pair is seen by another: all are fitted together."""

import itertools

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize

from gcar_deploy.config import PoseOptions
from gcar_deploy.geometry.epipolar import plane_normal
from gcar_deploy.geometry.prior import OFFSET_MM
from gcar_deploy.pose import joint, pairwise
from gcar_deploy.pose.pairwise import estimate_poses

render = pytest.importorskip("gcar_export.scenes.render", reason="needs the export extra")
from gcar_export.scenes.trees import random_tree  # noqa: E402
from tests.predict.test_hull import carm  # noqa: E402

TOLD = (carm(-30, -20), carm(45, 25), carm(-30, 25), carm(45, -25))


def pictures(moved, seed, views=TOLD):
    tree = random_tree(np.random.default_rng(seed)).sides("left").segments()
    return [
        (told, render.path_lengths(told.moved(shift), *tree))
        for told, shift in zip(views, moved, strict=False)
    ]


def moves(count, seed):
    rng = np.random.default_rng(seed)
    return [np.zeros(3), *(rng.normal(0, 3, 3) for _ in range(count - 1))]


def worst_visible_mm(poses, moved):
    """Worst error of any pair along its own normal: what keeps rays of one point apart."""
    wrong = [np.array(p.offset_mm) - m for p, m in zip(poses, moved, strict=True)]
    return max(
        abs(plane_normal(TOLD[i], TOLD[j]) @ (wrong[j] - wrong[i]))
        for i, j in itertools.combinations(range(len(poses)), 2)
    )


@pytest.mark.parametrize("seed", [4, *(pytest.param(s, marks=pytest.mark.slow) for s in (6, 8))])
@pytest.mark.parametrize("count", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_known_shifts_are_found_where_pairs_alone_miss_them(count, seed, monkeypatch):
    moved = moves(count, seed)
    together = estimate_poses(pictures(moved, seed), PoseOptions())
    monkeypatch.setattr(
        pairwise, "estimate_jointly", lambda masses, first, options, marks: (first, True)
    )
    apart = estimate_poses(pictures(moved, seed), PoseOptions())
    assert worst_visible_mm(together, moved) < 0.4
    assert worst_visible_mm(together, moved) < 0.25 * worst_visible_mm(apart, moved)
    assert together[0].offset_mm == (0, 0, 0)
    assert all(p.after <= p.before for p in together[1:])


def test_one_moved_view_hardly_moves_the_others():
    """What no pair sees of a move, the priors share out; what pairs see is right."""
    moved = [np.zeros(3), np.zeros(3), np.zeros(3), np.array([0.0, 5.0, 4.0])]
    poses = estimate_poses(pictures(moved, 5), PoseOptions())
    assert max(p.shift_mm for p in poses[:3]) < 2.0
    assert sum(p.shift_mm**2 for p in poses) <= 5.0**2 + 4.0**2
    assert worst_visible_mm(poses, moved) < 0.4


def test_nothing_is_corrected_where_nothing_is_wrong():
    poses = estimate_poses(pictures([np.zeros(3)] * 3, 4), PoseOptions())
    assert all(p.shift_mm == 0 and p.turn_deg == 0 for p in poses)


def test_two_views_never_come_here(monkeypatch):
    def refuse(*_):
        raise AssertionError("joint fit of two views")

    moved = moves(2, 4)
    as_ever = estimate_poses(pictures(moved, 4), PoseOptions())
    monkeypatch.setattr(pairwise, "estimate_jointly", refuse)
    assert estimate_poses(pictures(moved, 4), PoseOptions()) == as_ever


def test_a_blank_view_and_one_direction_twice():
    """Two pairs are no joint problem; directions that nearly coincide are not compared."""
    moved = moves(3, 4)
    views = pictures(moved, 4)
    blank = [*views[:2], (views[2][0], np.zeros_like(views[2][1]))]
    assert estimate_poses(blank, PoseOptions())[1] == estimate_poses(views[:2], PoseOptions())[1]
    twice = [views[0], views[1], views[1]]
    poses = estimate_poses(twice, PoseOptions())
    assert poses[1].offset_mm == poses[2].offset_mm


def test_offsets_are_as_good_as_those_of_a_search_from_one_start_after_the_other():
    """Curves with many minima; the oracle is L-BFGS of scipy without any slope of ours."""
    rng = np.random.default_rng(3)
    steps = np.arange(-24.0, 25.0)
    curves = [CubicSpline(steps, 30 * rng.random(49), bc_type="clamped") for _ in range(6)]
    along, starts = rng.normal(size=(6, 6)), rng.normal(0, 6, (30, 6))

    def misfit(x):
        shifts = np.clip(along @ x, -24.0, 24.0)
        return np.sum((x / OFFSET_MM) ** 2) + sum(c(s) for c, s in zip(curves, shifts, strict=True))

    found = joint._lowest(starts, along, np.stack([c.c for c in curves], axis=2), steps)
    oracle = min(minimize(misfit, s, method="L-BFGS-B").fun for s in starts[:8])
    assert misfit(found) <= oracle + 1e-3
    # Nothing near is lower: the search has ended, not just stopped.
    assert minimize(misfit, found, method="L-BFGS-B").fun > misfit(found) - 1e-3
