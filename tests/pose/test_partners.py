"""Likely devices go where the views agree a little better without them; vessels stay."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.imaging.stray_lines import without_line
from gcar_deploy.pose import partners
from gcar_deploy.pose.pairwise import Pose
from gcar_deploy.pose.partners import BACK_GAIN, GAIN, LIKELY, MOST_FITTED, partnered
from tests.imaging.test_stray_lines import CROSSING, MIDDLE, VESSEL, view_of

AGREED, ENOUGH, CONTRADICT = 0.05, 0.1, 0.18


def crossed(said: float, turned_deg: float = 0.0):
    """A vessel and a line from the border to it, which the network calls so probably a device.

    The line runs along the epipolar planes, so that nobody can say whether it crosses too many.
    """
    left = CROSSING[0], slice(0, MIDDLE)
    view = view_of(VESSEL, left)
    carm = dataclasses.replace(view.carm, primary_angle_deg=turned_deg)
    view = dataclasses.replace(view, carm=carm)
    device = np.zeros(view.mask.shape, np.float32)
    device[CROSSING[0], : MIDDLE - 8] = said
    return dataclasses.replace(view, device=device)


def there(view) -> bool:
    return bool(view.mask[CROSSING[0], 20].any())


def poses(after: float):
    return (Pose(), Pose(after=after))


def never(tried, poses):
    raise AssertionError("two views are fitted at once")


def asked(said, after, may=(True, True)):
    """Which of two views keep the line, where ``after`` says how well views with so many agree."""
    views = [crossed(one, 90.0 * k) for k, one in enumerate(said)]

    def estimate(tried):
        return poses(after(*(there(view) for view in tried)))

    kept, found = partnered(views, estimate(views), may, ENOUGH, CONTRADICT, estimate, never)
    assert found[1].after == after(*(there(view) for view in kept))
    return [there(view) for view in kept]


SURE = min(1.0, LIKELY + 0.2)


def better(one, two):
    return AGREED if one else 0.9 * AGREED


def test_a_likely_device_goes_where_the_views_agree_a_little_better_without_it():
    assert asked((SURE, 0.0), better) == [False, True]
    assert asked((SURE, 0.0), better, may=(False, True)) == [True, True]
    assert asked((SURE, 0.0), lambda one, two: AGREED) == [True, True]


def test_it_stays_where_they_agree_less_without_it():
    assert asked((SURE, 0.0), lambda one, two: AGREED if one else 1.2 * AGREED) == [True, True]


def test_no_more_ways_are_asked_than_are_worth_it(monkeypatch):
    monkeypatch.setattr(partners, "MOST_WAYS", 0)
    assert asked((SURE, 0.0), better) == [True, True]


def test_what_is_no_likely_device_is_not_asked_while_the_views_agree():
    assert asked((0.5 * LIKELY, 0.0), better) == [True, True]
    # where they do not, it has to help more than a likely one
    worse = 2 * ENOUGH
    assert asked((0.0, 0.0), lambda one, two: worse if one else 0.95 * worse) == [True, True]
    assert asked((0.0, 0.0), lambda one, two: worse if one else 0.5 * worse) == [False, True]


def test_a_line_from_outside_is_likely_one_where_the_other_view_has_a_device_from_there():
    """Both views show the catheter, and one tells it."""
    view, other = crossed(0.0), view_of(VESSEL)
    left = np.zeros(view.mask.shape, bool)

    def kept(device):
        views = [view, dataclasses.replace(other, catheter=device)]
        return there(
            partnered(
                views, poses(AGREED), (True, True), ENOUGH, CONTRADICT,
                lambda tried: poses(better(there(tried[0]), False)), never,
            )[0][0]
        )  # fmt: skip

    assert kept(left)
    left[CROSSING[0], 40:80] = True
    assert kept(left)
    left[CROSSING[0], :40] = True
    assert not kept(left)


@pytest.mark.parametrize(("said", "kept"), [((SURE, SURE), False), ((SURE, 0.0), True)])
def test_what_both_views_call_a_device_goes_if_without_both_they_agree_better(said, kept):
    """A catheter that both show: without it in one of them alone, they agree less."""
    found = asked(said, lambda one, two: AGREED * (2 if one != two else 1 if one else 0.9))
    assert found == [kept, kept]


@pytest.mark.parametrize(
    ("before", "share", "back"),
    [
        (2 * ENOUGH, GAIN - 0.01, True),
        (2 * ENOUGH, 0.95, False),
        (AGREED, BACK_GAIN - 0.01, True),
        (AGREED, BACK_GAIN + 0.01, False),
    ],
)
def test_a_lost_line_comes_back_where_the_views_agree_far_better_with_it(before, share, back):
    whole = crossed(0.0)
    lost = without_line(view_of(VESSEL, CROSSING), view_of(CROSSING).skeleton)
    views = [dataclasses.replace(lost, kept=lambda: whole), crossed(0.0, 90.0)]
    assert not there(views[0]) and there(whole)

    def estimate(tried):
        return poses(share * before if there(tried[0]) else before)

    kept, found = partnered(
        views, estimate(views), (True, False), ENOUGH, CONTRADICT, estimate, never
    )
    assert there(kept[0]) == back and kept[1] is views[1]
    assert found[1].after == (share * before if back else before)
    # A picture whose mask the user gave is left alone.
    left = partnered(views, estimate(views), (False, False), ENOUGH, CONTRADICT, estimate, never)[0]
    assert left[0] is views[0]


def test_a_vessel_comes_back_rather_than_its_twin_goes():
    """Without it in the one view or with it in the other the views agree about as well."""
    whole = crossed(0.0)
    lost = without_line(view_of(VESSEL, CROSSING), view_of(CROSSING).skeleton)
    views = [dataclasses.replace(lost, kept=lambda: whole), crossed(SURE, 90.0)]
    agree = {(True, True): 1.1 * ENOUGH, (False, False): ENOUGH}

    def estimate(tried):
        return poses(agree.get((there(tried[0]), there(tried[1])), 2 * ENOUGH))

    kept, _ = partnered(views, estimate(views), (True, True), ENOUGH, CONTRADICT, estimate, never)
    assert [there(view) for view in kept] == [True, True]


@pytest.mark.parametrize("both", [False, True])
def test_what_comes_from_outside_in_two_views_is_a_catheter(both):
    """One view would agree far better with its line back; the other has lost such a line, too."""
    whole = crossed(0.0)
    lost = without_line(view_of(VESSEL, CROSSING), view_of(CROSSING).skeleton)
    lost = dataclasses.replace(lost, kept=lambda: whole)
    views = [lost, dataclasses.replace(lost) if both else whole]

    def estimate(tried):
        return poses(0.5 * AGREED if there(tried[0]) else AGREED)

    kept, _ = partnered(views, estimate(views), (True, True), ENOUGH, CONTRADICT, estimate, never)
    assert there(kept[0]) is not both


@pytest.mark.parametrize(("count", "ways", "best"), [(4, (8 + 24, 6 + 12), 8), (5, (10, 8), 6)])
def test_of_three_and_more_views_what_agrees_best_where_they_stand_is_fitted(count, ways, best):
    """Views of a line that is likely a device, each with two ways to leave it out.

    One or two lines of four views go at once, one of five.
    """
    views = [crossed(SURE) for _ in range(count)]
    fitted, placed = [], []

    def agreed(tried):
        # Without the last one they agree best, and the fit says so too.
        return poses((0.5 if not there(tried[3]) else 0.9) * AGREED + 0.001 * len(where(tried)))

    def where(tried):
        return [k for k, view in enumerate(tried) if not there(view)]

    def estimate(tried):
        fitted.append(where(tried))
        return agreed(tried)

    def judge(tried, known):
        placed.append(where(tried))
        return agreed(tried)

    start = poses(AGREED)
    kept, found = partnered(views, start, (True,) * count, ENOUGH, CONTRADICT, estimate, judge)
    assert where(kept) == [3] and found[1].after == pytest.approx(0.5 * AGREED + 0.001)
    # The second round has a view less to ask.
    assert len(placed) == sum(ways) and len(fitted) == 2 * MOST_FITTED
    # Of five views just two ways of the first round are without the last one.
    assert sum(3 in one for one in fitted) == best
