"""What else would explain the pictures nearly as well, each with the correction that picks it."""

from __future__ import annotations

from typing import Any

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import plane_angles
from gcar_deploy.result import Result
from gcar_deploy.tree.edit import part_of
from gcar_deploy.tree.tree import Branch
from gcar_deploy.types import Points


def alternatives(result: Result) -> list[dict[str, Any]]:
    """List what ``ambiguity`` of result.json states, for the page.

    Returns
    -------
    per alternative ``text``; ``branches`` (numbers) and ``place`` (mm LPS) that it is about, with
    the place in each view (``at``, [column, row]); ``does`` and ``add``: what picking it is called
    and what it adds to the order's corrections, None and nothing where no correction picks it
    """
    told = result.summary()["ambiguity"]
    found = [_ghost(result, one) for one in told["probable_ghosts"]]
    found += [_exchange(result, one) for one in told["exchangeable"]]
    found += [_close_call(result, one) for one in told["close_calls"]]
    return found


def exchange_marks(
    first: Branch, second: Branch, carms: tuple[CArm, CArm]
) -> list[list[list[float]]]:
    """Return marks that say: the first branch of one view is the second branch of the other.

    Each is a pair of places in one epipolar plane, (column, row), and both ways round.
    """
    out = []
    for one, other in ((first, second), (second, first)):
        start = _middle(one)
        here, _ = carms[0].project(start[None])
        plane = plane_angles(*carms, carms[0], here)
        there, _ = carms[1].project(other.points_mm)
        gaps = np.abs(plane_angles(*carms, carms[1], there) - plane)
        out.append([_rounded(here[0]), _rounded(there[int(gaps.argmin())])])
    return out


def _ghost(result: Result, told: dict[str, Any]) -> dict[str, Any]:
    text = (
        f"Branch {told['branch']}, {told['start_mm']:.0f} to {told['end_mm']:.0f} mm: a ghost with "
        f"probability {told['probability']:.0%}"
    )
    return _entry(result, text, [told["branch"]], told["middle_mm"],
                  ("Delete the branch", {"deleted_mm": [_place(told["middle_mm"])]}))  # fmt: skip


def _exchange(result: Result, told: dict[str, Any]) -> dict[str, Any]:
    a, b = told["branches"]
    first, second = (
        _stretch(result.tree.branches[k - 1], *ends)
        for k, ends in zip((a, b), told["stretches_mm"], strict=True)
    )
    marks = exchange_marks(first, second, (result.views[0].carm, result.views[1].carm))
    whose = f"The two ways of branch {a}" if a == b else f"Branches {a} and {b}"
    text = f"{whose} could change partners between the views without a trace"
    return _entry(
        result, text, [a, b], told["middles_mm"][0], ("Exchange them", {"same_branch": marks})
    )


def _close_call(result: Result, told: dict[str, Any]) -> dict[str, Any]:
    place, length = np.asarray(told["middle_mm"], float), told["length_mm"]
    if not told["kept"]:
        return _entry(result, f"A vessel of {length:.0f} mm was left out by a hair", [], place,
                      None)  # fmt: skip
    gaps = [
        float(np.linalg.norm(branch.points_mm - place, axis=1).min())
        for branch in result.tree.branches
    ]
    number = int(np.argmin(gaps)) + 1
    return _entry(result, f"Branch {number} ({length:.0f} mm) was kept by a hair", [number], place,
                  ("Delete the branch", {"deleted_mm": [_place(place)]}))  # fmt: skip


def _entry(
    result: Result, text: str, branches: list[int], place: Any, pick: tuple[str, Any] | None
) -> dict[str, Any]:
    point = np.asarray(place, float)[None]
    does, add = (None, {}) if pick is None else pick
    return {
        "text": text, "branches": branches, "place": _place(place),
        "at": [_rounded(view.carm.project(point)[0][0]) for view in result.views],
        "does": does, "add": add,
    }  # fmt: skip


def _stretch(branch: Branch, start_mm: float, end_mm: float) -> Branch:
    first, last = (int(np.argmin(np.abs(branch.arc_mm - at))) for at in (start_mm, end_mm))
    return part_of(branch, first, last)


def _middle(branch: Branch) -> Points:
    at: Points = branch.points_mm[int(np.argmin(np.abs(branch.arc_mm - 0.5 * branch.length_mm)))]
    return at


def _place(place: Any) -> list[float]:
    return [round(float(x), 2) for x in place]


def _rounded(pixel: Any) -> list[float]:
    return [round(float(x), 1) for x in pixel]
