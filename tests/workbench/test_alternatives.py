"""Stated alternatives: which correction picks them, and whether the marks say what they should."""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.geometry.epipolar import plane_angles
from gcar_deploy.inputs.order import Order, parse_order
from gcar_deploy.quality.alternatives import Exchange
from gcar_deploy.tubes import CloseCall
from gcar_deploy.workbench.alternatives import alternatives, exchange_marks
from tests.output.made_results import with_ghost

BASE = {"views": ["a", "b"]}


def nearest_branch(result, place):
    gaps = [np.linalg.norm(b.points_mm - place, axis=1).min() for b in result.tree.branches]
    return int(np.argmin(gaps)) + 1, min(gaps)


def test_marks_of_an_exchange_lie_on_both_vessels_in_one_epipolar_plane(result):
    carms = tuple(view.carm for view in result.views)
    first, second = result.tree.branches[0], result.tree.branches[1]
    marks = exchange_marks(first, second, carms)
    for mark, branches in zip(marks, ((first, second), (second, first)), strict=True):
        for carm, branch, point in zip(carms, branches, mark, strict=True):
            gaps = np.linalg.norm(carm.project(branch.points_mm)[0] - point, axis=1)
            assert gaps.min() < 1.0
        at = [plane_angles(*carms, carm, np.array([p]))[0]
              for carm, p in zip(carms, mark, strict=True)]  # fmt: skip
        other = carms[1].project(branches[1].points_mm)[0]
        planes = plane_angles(*carms, carms[1], other)
        # As near to the first mark's plane as the second vessel comes.
        assert abs(at[1] - at[0]) < np.abs(planes - at[0]).min() + 2e-3
    parse_order({**BASE, "same_branch": marks})


def test_every_alternative_of_a_result_is_told_with_what_picks_it(result):
    ghost = with_ghost(result)
    branches = ghost.tree.branches
    exchange = Exchange(
        branches=(0, 1), difference=0.1,
        stretches_mm=((0.0, branches[0].length_mm), (0.0, branches[1].length_mm)),
    )  # fmt: skip
    middle = branches[1].points_mm[len(branches[1]) // 2]
    made = dataclasses.replace(
        ghost,
        quality=dataclasses.replace(ghost.quality, exchanges=(exchange,)),
        close_calls=(
            CloseCall(middle_mm=middle, length_mm=9.0, kept=True),
            CloseCall(middle_mm=np.array([1.0, 2.0, 3.0]), length_mm=7.0, kept=False),
        ),
    )
    told = alternatives(made)
    assert [one["does"] for one in told] == [
        "Delete the branch", "Exchange them", "Delete the branch", None,
    ]  # fmt: skip
    for one in told:
        assert parse_order({**BASE, **one["add"]}) != Order() and len(one["at"]) == 2
    for one in (told[0], told[2]):
        (place,) = one["add"]["deleted_mm"]
        number, gap = nearest_branch(made, place)
        assert [number] == one["branches"] and gap < 0.5
    assert told[1]["branches"] == [1, 2] and len(told[1]["add"]["same_branch"]) == 2
    assert told[3]["add"] == {} and told[3]["place"] == [1.0, 2.0, 3.0]
    assert "9 mm" in told[2]["text"] and "left out by a hair" in told[3]["text"]
    assert alternatives(dataclasses.replace(result, close_calls=())) == [
        one for one in alternatives(result) if "by a hair" not in one["text"]
    ]
