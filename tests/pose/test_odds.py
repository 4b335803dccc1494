"""Of two views that contradict each other the line goes that all witnesses together give away."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.imaging.stray_lines import without_line
from gcar_deploy.pose.odds import lines_of, without_likeliest
from gcar_deploy.pose.pairwise import Pose
from gcar_deploy.pose.partners import GAIN, partnered
from tests.imaging.test_stray_lines import BRANCH, MIDDLE, VESSEL, view_of

#: from the border down to the vessel, across the planes of views that turn about the body
SLANTED = [(slice(30 + k, 36 + k), slice(k, k + 6)) for k in range(0, MIDDLE, 2)]
WORST = 0.3


def views_of(said: float = 0.5, *, both: bool = False):
    """A vessel in two views, and a line in the first one, or in both."""
    one = view_of(VESSEL, BRANCH, *SLANTED)
    two = one if both else view_of(VESSEL, BRANCH)
    device = np.zeros(one.mask.shape, np.float32)
    for stroke in SLANTED:
        device[stroke] = said
    carm = dataclasses.replace(two.carm, primary_angle_deg=60.0)
    return [dataclasses.replace(one, device=device), dataclasses.replace(two, carm=carm)]


def slanted(view) -> bool:
    return bool(view.mask[SLANTED[20]].any())


def left_out(views, share, *, asked=(True, True), least=(0.0, 0.0), devices=(False, False)):
    """What goes, where the views agree so much better without the slanted line."""

    def estimate(tried):
        return (Pose(), Pose(after=WORST if slanted(tried[0]) else share * WORST))

    return without_likeliest(views, estimate(views), asked, least, devices, lines_of, estimate)


def test_a_line_that_one_view_shows_goes_where_the_network_is_undecided() -> None:
    views = views_of()
    out = left_out(views, 0.8)
    assert out is not None
    fewer, poses = out
    assert not slanted(fewer[0]) and fewer[1] is views[1]
    assert poses[1].after == pytest.approx(0.8 * WORST)
    # The vessel and its branch stay.
    assert fewer[0].mask[BRANCH].all() and fewer[0].mask[VESSEL][60:].all()


@pytest.mark.parametrize(
    ("said", "share", "goes"),
    [(0.0, 0.1, False), (0.2, 0.95, False), (0.2, 0.6, True), (0.9, 1.0, True)],
)
def test_the_network_is_overruled_where_it_is_not_sure_of_a_vessel(said, share, goes) -> None:
    assert (left_out(views_of(said), share) is not None) == goes


def test_what_the_other_view_shows_as_well_stays() -> None:
    assert left_out(views_of(0.5, both=True), 0.9) is None


def test_a_line_from_outside_is_likelier_where_the_other_view_has_a_device_from_there() -> None:
    views = views_of(0.15)
    assert left_out(views, 0.95) is None
    assert left_out(views, 0.95, devices=(False, True)) is not None


def test_what_nobody_asks_stays_and_so_does_enough_of_a_view() -> None:
    views = views_of()
    assert left_out(views, 0.8, asked=(False, True)) is None
    assert left_out(views, 0.8, least=(0.95 * views[0].skeleton.sum(), 0.0)) is None


def partners_of(views, estimate):
    """What is left of the first view; from 0.2 on two views contradict each other."""

    def never(tried, poses):
        raise AssertionError("two views are fitted at once")

    return partnered(views, estimate(views), (True, True), 0.1, 0.2, estimate, never)[0][0]


@pytest.mark.parametrize(("before", "stays"), [(0.15, True), (WORST, False)])
def test_odds_are_asked_where_the_views_contradict_each_other(before, stays) -> None:
    views = views_of(0.4)

    def estimate(tried):
        return (Pose(), Pose(after=before * (1.0 if slanted(tried[0]) else GAIN + 0.05)))

    assert slanted(partners_of(views, estimate)) == stays


def test_what_goes_by_its_odds_does_not_come_and_go_for_ever() -> None:
    """With a line back that was taken for a device the views agree better; it is one all the same.

    The views contradict each other with it and without it.
    """
    whole, other = views_of(0.95)
    line = whole.skeleton & ~other.skeleton
    lost = dataclasses.replace(without_line(whole, line), kept=lambda: whole)
    assert not slanted(lost)
    asked = []

    def estimate(tried):
        asked.append(slanted(tried[0]))
        assert len(asked) < 100
        return (Pose(), Pose(after=WORST * (GAIN - 0.05 if slanted(tried[0]) else 1.0)))

    assert not slanted(partners_of([lost, other], estimate))
    assert any(asked)
