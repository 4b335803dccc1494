"""An angle or a scale that is wrong is asked for, whatever else the pictures differ by."""

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import QualityOptions, RunOptions
from gcar_deploy.pose import register
from gcar_deploy.pose.agreement import poses_between, profiled
from gcar_deploy.pose.significance import Pair, asked
from gcar_deploy.quality import check_asked
from tests.pose.test_agreement import pair

OPTIONS = RunOptions()


def spoilt(seed=3):
    """Two views of one tree, their brightness wrong by some hundredths, as in raw ones."""
    rng = np.random.default_rng(seed)
    views = []
    for view in pair()[1]:
        rows, cols = np.mgrid[: view.carm.rows, : view.carm.columns] / 30.0
        waves = sum(
            np.sin(rng.uniform(0, 6) + rng.normal() * rows + rng.normal() * cols) for _ in range(4)
        )
        path = (view.path_mm * (1 + 0.05 * waves)).astype(np.float32)
        views.append(dataclasses.replace(view, path_mm=path))
    return views


def told(views, **how):
    return [views[0], dataclasses.replace(views[1], carm=dataclasses.replace(views[1].carm, **how))]


def findings(views):
    (one,) = asked(views, poses_between(views, OPTIONS), OPTIONS)
    turn = one.turn_deg, one.turned, one.turn_gain
    scale = one.scale, one.scaled, one.scale_gain
    quality = OPTIONS.quality
    return one, check_asked(("1", "2"), one.given, turn, scale, quality, one.uncovered_mm)


def test_right_views_ask_for_nothing():
    one, said = findings(spoilt())
    assert said == [] and one.scale == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("by", [-4, 4])
def test_a_wrong_angle_is_asked_for(by):
    views = spoilt()
    one, (said,) = findings(told(views, secondary_angle_deg=views[1].carm.secondary_angle_deg + by))
    assert "turned by" in said and "view 2" in said
    assert one.turned < 0.9 * one.given and 1.5 < one.turn_deg < 8


@pytest.mark.parametrize("factor", [0.93, 1.08])
def test_a_wrong_scale_of_one_view_is_asked_for_with_its_factor(factor):
    views = spoilt()
    spacing = tuple(factor * mm for mm in views[1].carm.pixel_spacing_mm)
    one, (said,) = findings(told(views, pixel_spacing_mm=spacing))
    assert one.scale == pytest.approx(1 / factor, abs=0.02)
    assert "spacing, SDD or SOD" in said and ("smaller" if factor > 1 else "larger") in said
    assert "not filled" not in said


@pytest.mark.parametrize("calibrated", [False, True])
def test_vessel_that_is_not_filled_is_named_beside_what_it_looks_like(calibrated):
    """A scale, and where the pictures are exact, a contradiction."""
    first, second = pair(calibrated=True)[1] if calibrated else spoilt()
    shown = np.arange(second.carm.rows)[:, None] < np.median(np.nonzero(second.path_mm)[0])
    half = {name: getattr(second, name) * shown for name in ("path_mm", "mask", "skeleton")}
    views = [first, dataclasses.replace(second, **half)]
    placed = register(pair()[0], views, OPTIONS, lambda _: pytest.fail("two views need no tree"))
    assert ("view are not filled or cut off, or different" in placed.refusal) == calibrated
    if calibrated:
        return
    said = next(text for text in placed.findings if "pixels were" in text)
    assert "SDD or SOD wrong, or are vessels of one view not filled or cut off" in said


@pytest.mark.parametrize(
    ("by_deg", "scale", "content"), [(0, 1, True), (0.7, 1, False), (0, 1.01, False)]
)
def test_slopes_tell_whether_a_fit_is_worth_it(by_deg, scale, content):
    fixed, moving = profiled(pair(calibrated=True)[1], OPTIONS)[0]
    carm = moving.carm
    spacing = tuple(scale * mm for mm in carm.pixel_spacing_mm)
    off = dataclasses.replace(
        carm, secondary_angle_deg=carm.secondary_angle_deg + by_deg, pixel_spacing_mm=spacing
    )
    assert Pair(fixed, dataclasses.replace(moving, carm=off), 1.5, 1.2).content == content
    raw = dataclasses.replace(moving, calibrated=False)
    assert not Pair(fixed, raw, 1.5, 1.2).content


def test_the_registration_says_it():
    views = spoilt()
    given = told(views, secondary_angle_deg=views[1].carm.secondary_angle_deg + 4)
    placed = register(pair()[0], given, OPTIONS, lambda _: pytest.fail("two views need no tree"))
    assert any("if it were turned by" in said for said in placed.findings)


@pytest.mark.parametrize(
    ("given", "turn", "scale", "said"),
    [
        (0.12, (3.0, 0.09, 1.5), (1.0, 0.12, 1.0), "turned by 3.0 deg"),
        (0.12, (1.0, 0.09, 1.5), (1.0, 0.12, 1.0), ""),  # as small as angles are read
        (0.12, (3.0, 0.115, 1.5), (1.0, 0.12, 1.0), ""),
        (0.12, (3.0, 0.09, 1.1), (1.0, 0.12, 1.0), ""),
        (0.004, (3.0, 0.001, 9.0), (1.0, 0.004, 1.0), ""),  # pixels
        (0.12, (3.0, 0.09, 1.5), (1.06, 0.07, 2.0), "6% larger"),
        (0.12, (3.0, 0.07, 1.5), (0.94, 0.09, 2.0), "turned by"),
        (0.12, (0.0, 0.12, 1.0), (1.01, 0.07, 2.0), ""),
    ],
)
def test_what_is_significant(given, turn, scale, said):
    found = check_asked(("1", "2"), given, turn, scale, QualityOptions())
    assert (said in found[0]) if said else found == []
