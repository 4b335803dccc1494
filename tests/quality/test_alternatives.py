"""What two views leave open: exchangeable vessels, and evidence in other places."""

import numpy as np
import pytest

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.predict import Evidence
from gcar_deploy.quality.alternatives import evidence_elsewhere, exchanges, findings, turning_points
from gcar_deploy.quality.shown import Shown
from gcar_deploy.tree.edit import with_branch
from gcar_deploy.tree.tree import Tree, empty_tree
from tests.hard.phantoms import PAIR, bars, carm, seven, straight
from tests.tree.shapes import branch

VIEWS = (carm(-40), carm(45))


def test_parallel_bars_of_one_width_can_be_exchanged():
    found = exchanges(bars(3), VIEWS)
    assert len(found) == 3 and max(e.difference for e in found) < 0.15
    (sentence,) = findings(found, None)
    assert found[0].branches == (0, 1)
    assert "40 and 40 mm (branches 1 and 2)" in sentence and "2 more pairs" in sentence


def test_a_third_view_a_single_vessel_and_a_tree_leave_nothing_open():
    assert exchanges(bars(3), (*VIEWS, carm(0, 30))) == ()
    assert exchanges(straight(), VIEWS) == ()
    assert exchanges(empty_tree(), VIEWS) == ()
    assert exchanges(seven(), PAIR) == ()


@pytest.mark.parametrize("change", ["thicker", "higher"])
def test_vessels_that_differ_in_mass_or_place_cannot_be_exchanged(change):
    import dataclasses

    two = bars(2)
    first, second = two.branches
    if change == "thicker":
        second = dataclasses.replace(second, radius_mm=1.5 * second.radius_mm)
    else:
        second = dataclasses.replace(second, points_mm=second.points_mm + np.array([0, 0, 12.0]))
    assert exchanges(dataclasses.replace(two, branches=(first, second)), VIEWS) == ()


def _with_twigs(tree, places, length_mm):
    """A twig across each bar, ``places`` of the way along it."""
    twig = np.linspace(0.0, length_mm, 8)[:, None] * np.array([0.6, 0.8, 0.0])
    for bar, place in zip(tree.branches, places, strict=True):
        line = bar.points_mm[round(place * (len(bar) - 1))] + twig
        tree = with_branch(tree, line, 0.5, 1.0, 0.5)
    return tree


def test_vessels_are_the_same_past_the_spurs_that_part_them():
    parted = _with_twigs(bars(2), (0.35, 0.65), 6.0)
    (found,) = exchanges(parted, VIEWS)
    assert found.difference < 0.15
    for number, (start, end) in zip(found.branches, found.stretches_mm, strict=True):
        assert start == 0.0
        assert end == parted.branches[number].length_mm == pytest.approx(26.0, abs=1.0)
    # A branch of some length parts a vessel in two.
    assert exchanges(_with_twigs(bars(2), (0.35, 0.65), 14.0), VIEWS) == ()


def test_no_vessel_is_exchanged_with_its_own_branch():
    """A spur parts it into 90 and 12 mm: the whole differs from the former by 6 %."""
    line = np.linspace(-51.0, 51.0, 103)[:, None] * np.array([0.0, 0.0, 1.0])
    one = Tree(nodes_mm=line[[0, -1]], branches=(branch(line, np.full(103, 1.2)),))
    parted = _with_twigs(one, (90 / 102,), 6.0)
    assert len(parted.branches) == 3
    assert exchanges(parted, VIEWS) == ()


def hairpin(thinner: float = 1.0):
    """A vessel that comes down, turns and goes up again, 50 mm each way, and its two radii."""
    turn = np.linspace(0, np.pi, 40)
    z = np.linspace(40, -10, 60)
    down = np.stack([-8 + 0.0 * z, 3 + 0 * z, z], 1)
    round_ = np.stack([-8 * np.cos(turn), 3 * np.cos(turn), -10 - 8 * np.sin(turn)], 1)
    up = np.stack([8 + 0 * z, -3 + 0 * z, z[::-1]], 1)
    line = np.concatenate([down, round_[1:-1], up])
    radius = np.where(np.arange(len(line)) < len(line) // 2, 1.4, 1.4 * thinner)
    return Tree(nodes_mm=line[[0, -1]], branches=(branch(line, radius),))


def test_the_two_ways_of_a_vessel_that_turns_back_can_be_exchanged():
    """A loop that closes where it turns: as masks show it, no width says which way is which."""
    for masks in (False, True):
        (one,) = exchanges(hairpin(), VIEWS, masks=masks)
        (start, turn), (again, end) = one.stretches_mm
        assert one.branches == (0, 0) and start == 0 and turn == again
        assert 55 < turn < 75 and end > 120
    (sentence,) = findings([one], None)
    assert "both of branch 1" in sentence
    assert exchanges(hairpin(0.8), VIEWS, masks=True) == ()


def test_a_series_turns_back_where_it_goes_on_far_enough():
    up = np.arange(0.0, 10.0)
    assert turning_points(up, 4.0) == [0, 9]
    assert turning_points(-up, 4.0) == [0, 9]
    assert turning_points(np.concatenate([up, up[-2::-1], up[1:]]), 4.0) == [0, 9, 18, 27]
    assert turning_points(np.concatenate([up, 9 - 0.3 * up]), 4.0) == [0, 19]
    assert turning_points(np.concatenate([3 - up[:4], up]), 4.0) == [0, 13]


def test_evidence_on_the_tree_and_beside_it():
    tree = straight((0, 0, 1.0), 40.0, 1.0)
    z = np.arange(-18.0, 19.0)
    on = np.stack([0 * z, 0 * z, z], 1)
    points = np.concatenate([on, on + np.array([10.0, 0, 0])])
    told = CenterPoints(
        points_mm=points, confidence=np.repeat([0.6, 0.2], len(z)),
        radius_mm=np.full(len(points), np.nan), spacing_mm=1.0, source="multi",
    )  # fmt: skip
    ray = np.tile(np.arange(len(z)), 2)
    own = np.arange(2 * len(z))
    ones = np.ones((2, len(points)))
    apart, together = np.stack([own, own]), np.stack([own, ray])
    # One view sees both places on one ray, the other keeps them apart: the worst view counts.
    for rays, elsewhere in ((apart, 0.0), (together, 0.25)):
        shown = Shown(tree, (), Evidence(told, rays, ones))
        assert evidence_elsewhere(shown) == pytest.approx(elsewhere)
    assert evidence_elsewhere(Shown(tree, (), None)) is None
    assert findings((), 0.25) and not findings((), 0.05)
