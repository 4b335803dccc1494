"""Registration: what views that show one tree, or do not, are told before there is any tree."""

import dataclasses
import re

import numpy as np
import pytest

from gcar_deploy.config import PoseOptions, RunOptions
from gcar_deploy.errors import RefusedError
from gcar_deploy.pose import profile_fit, register, registration
from tests.pose.test_agreement import pair

OPTIONS = RunOptions()


def never(_):
    raise AssertionError("two views are placed without a tree")


def test_views_of_one_tree_stay_where_they_are():
    angiograms, views = pair(calibrated=True)
    placed = register(angiograms, views, OPTIONS, never)
    placed.or_refuse()
    assert (placed.findings, placed.hint, placed.refusal) == ((), "", "")
    assert placed.disagreement == placed.poses[1].after < OPTIONS.quality.good_disagreement
    assert [view.carm for view in placed.views] == [view.carm for view in views]


def test_a_move_between_the_runs_is_built_into_the_views_and_said():
    angiograms, views = pair(calibrated=True)
    told = dataclasses.replace(views[1], carm=views[1].carm.moved((0.0, 0.0, 9.0)))
    placed = register(angiograms, [views[0], told], OPTIONS, never)
    (said,) = placed.findings
    assert "had to be moved" in said and placed.refusal == ""
    assert placed.views[1].carm == placed.poses[1].applied(told.carm) != told.carm
    assert placed.views[0] is views[0]


def test_a_refusal_names_what_the_user_drew_before_it_doubts_the_pictures():
    angiograms, views = pair(calibrated=True)
    erased = dataclasses.replace(angiograms[1], erased=np.zeros(views[1].mask.shape, bool))
    options = dataclasses.replace(OPTIONS, ostia=(((90.0, 90.0), (90.0, 90.0)),))
    placed = register([angiograms[0], erased], views, options, never)
    placed = dataclasses.replace(placed, refusal="they contradict each other; patients?")
    said = "the user's strokes in view 2, inlets (1) may be the reason: they contradict"
    with pytest.raises(RefusedError, match=re.escape(said)):
        placed.or_refuse()
    with pytest.raises(RefusedError, match="reason: too short"), placed.hinting():
        raise RefusedError("too short")
    plain = dataclasses.replace(placed, drawn="")
    with pytest.raises(RefusedError, match="they contradict"):
        plain.or_refuse()
    assert register(angiograms, views, OPTIONS, never).drawn == ""


@pytest.mark.slow
def test_two_trees_are_refused_when_asked_with_what_was_measured():
    angiograms, views = pair(seeds=(4, 9), calibrated=True)
    placed = register(angiograms, views, OPTIONS, never)
    assert placed.disagreement > OPTIONS.quality.max_disagreement
    with pytest.raises(RefusedError, match="contradict"):
        placed.or_refuse()


@pytest.mark.slow
def test_paths_of_another_scale_are_named_and_those_of_another_tree_are_not():
    angiograms, views = pair(calibrated=True)
    by_eight = dataclasses.replace(views[1], path_mm=views[1].path_mm / np.float32(8))
    with pytest.raises(RefusedError, match=r"add up to 0\.1[23] times.*mm_per_count right"):
        register(angiograms, [views[0], by_eight], OPTIONS, never).or_refuse()
    _, others = pair(seeds=(4, 9), calibrated=True)
    by_eight = dataclasses.replace(others[1], path_mm=others[1].path_mm / np.float32(8))
    placed = register(angiograms, [others[0], by_eight], OPTIONS, never)
    assert "contradict" in placed.refusal and "mm_per_count" not in placed.refusal


@pytest.mark.slow
def test_outlines_of_two_trees_that_agree_by_chance_are_refused_by_where_vessels_end(monkeypatch):
    angiograms, views = pair(seeds=(4, 9), stranger=True)
    placed = register(angiograms, views, OPTIONS, never)
    assert {view.kind for view in placed.views} == {"mask"} and placed.poses[1].motion_mm > 0
    assert placed.disagreement < OPTIONS.quality.good_disagreement_mask
    with pytest.raises(RefusedError, match=r"contrasts.*turn and end; .*pixel sizes"):
        placed.or_refuse()
    moved = placed.poses[1].motion_mm
    for least, refused in ((0.99 * moved, True), (1.01 * moved, False)):
        monkeypatch.setattr(registration, "LEAST_CONTRADICTION_MM", least)
        assert bool(register(angiograms, views, OPTIONS, never).refusal) is refused
    one = pair()[1]
    across = np.exp(2.0 * np.linspace(-1, 1, 192))[None]
    spoilt = [
        dataclasses.replace(view, path_mm=(view.path_mm * by).astype(np.float32))
        for view, by in zip(one, (across, 1 / across), strict=True)
    ]
    placed = register(pair()[0], spoilt, OPTIONS, never)
    assert {view.kind for view in placed.views} == {"mask"} and placed.refusal == ""


def test_a_refusal_says_that_the_pictures_may_be_swapped():
    angiograms, (one, two) = pair(calibrated=True)
    given = [dataclasses.replace(two, carm=one.carm), dataclasses.replace(one, carm=two.carm)]
    options = dataclasses.replace(OPTIONS, pose=PoseOptions(enabled=False))
    placed = register(angiograms, given, options, never)
    assert "contradict" in placed.refusal and "swapped?" in placed.refusal
    with pytest.raises(RefusedError, match=r"no tree.*swapped"), placed.hinting():
        raise RefusedError("no tree")


def test_a_pose_that_was_cut_short_is_told_and_degrades(monkeypatch):
    """With two looks at the profiles none is at its best; with the usual number all are."""
    angiograms, views = pair(calibrated=True)
    told = dataclasses.replace(views[1], carm=views[1].carm.moved((0.0, 0.0, 9.0)))
    asked = (angiograms, [views[0], told], OPTIONS, never)
    usual = register(*asked)
    assert all(pose.converged for pose in usual.poses)
    assert not any("cap of steps" in finding for finding in usual.findings)
    monkeypatch.setattr(profile_fit, "MAX_EVALUATIONS", 2)
    short = register(*asked)
    assert not short.poses[1].converged and short.poses[1].theta.any()
    assert any("cap of steps" in finding for finding in short.findings)
