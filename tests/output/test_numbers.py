"""Branches have one number and one direction in every file and on every page."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re

import numpy as np
import pytest

from gcar_deploy.measure.inlet import from_inlets
from gcar_deploy.output.bundle import render_files
from tests.measure.test_naming import left_tree
from tests.output.made_results import with_tree


@pytest.fixture(scope="module")
def files(result):
    tree = left_tree(backwards=True)
    thin = tree.branches[3]
    # A narrowing 30 mm from the far end, so that the two ends cannot be mistaken.
    gap = thin.arc_mm - 30.0
    radius = thin.radius_mm * (1 - 0.5 * np.exp(-0.5 * (gap / 2.0) ** 2))
    narrowed = dataclasses.replace(thin, radius_mm=radius)
    branches = (*tree.branches[:3], narrowed, tree.branches[4])
    tree = from_inlets(dataclasses.replace(tree, branches=branches))
    return render_files(with_tree(result, tree))


@pytest.fixture(scope="module")
def rows(files):
    """Number of a branch to its rows in centerline.csv."""
    out: dict[int, list[dict[str, float]]] = {}
    for row in csv.DictReader(io.StringIO(files["centerline.csv"].decode("ascii"))):
        numbers = {k: float(v or "nan") for k, v in row.items() if k != "name"}
        out.setdefault(int(row["branch"]), []).append(numbers)
    return out


@pytest.fixture(scope="module")
def told(files):
    return json.loads(files["result.json"])["tree"]


def place(row):
    return np.array([row["x_mm"], row["y_mm"], row["z_mm"]])


def test_result_json_and_csv_have_the_same_numbers(rows, told):
    assert [branch["branch"] for branch in told["branches"]] == sorted(rows) == [1, 2, 3, 4, 5]
    for branch in told["branches"]:
        own = rows[branch["branch"]]
        assert own[-1]["arc_mm"] == pytest.approx(branch["length_mm"], abs=1e-4)
        assert np.mean([row["radius_mm"] for row in own]) == pytest.approx(
            branch["mean_radius_mm"], abs=1e-4
        )


def test_branches_begin_where_the_one_they_leave_ends(rows, told):
    ends = {0: place(rows[1][0])}
    np.testing.assert_allclose(ends[0], (-30, 5, 38), atol=1e-4)
    for branch in told["branches"]:
        own = rows[branch["branch"]]
        np.testing.assert_allclose(place(own[0]), ends[branch["start"]], atol=1e-4)
        ends[branch["end"]] = place(own[-1])


def test_bifurcations_name_the_branches_that_meet_there(rows, told):
    for node in told["bifurcations"]:
        for angle in node["angles"]:
            for number in angle["branches"]:
                gaps = [
                    np.linalg.norm(place(rows[number][k]) - node["position_mm"]) for k in (0, -1)
                ]
                assert min(gaps) < 1e-3
    assert {n for node in told["bifurcations"] for a in node["angles"] for n in a["branches"]} == {
        1, 2, 3, 4, 5,
    }  # fmt: skip


def test_a_narrowing_is_measured_from_the_inlet(rows, told):
    worst = max(told["branches"], key=lambda branch: branch["stenosis_percent"] or 0.0)
    assert worst["stenosis_percent"] == pytest.approx(50, abs=3)
    assert worst["minimal_at_mm"] == pytest.approx(worst["length_mm"] - 30.0, abs=1.0)
    at = min(rows[worst["branch"]], key=lambda row: abs(row["arc_mm"] - worst["minimal_at_mm"]))
    assert 2 * at["radius_mm"] == pytest.approx(worst["minimal_diameter_mm"], abs=1e-3)


def test_vtp_has_the_numbers_and_directions_of_the_csv(files, rows, tmp_path):
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    (tmp_path / "line.vtp").write_bytes(files["centerline.vtp"])
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(tmp_path / "line.vtp"))
    reader.Update()
    data = reader.GetOutput()
    numbers = vtk_to_numpy(data.GetCellData().GetArray("BranchId")).tolist()
    assert numbers == sorted(rows)
    for k, number in enumerate(numbers):
        ids = data.GetCell(k).GetPointIds()
        ends = [data.GetPoint(ids.GetId(i)) for i in (0, ids.GetNumberOfIds() - 1)]
        np.testing.assert_allclose(ends[0], place(rows[number][0]), atol=1e-4)
        np.testing.assert_allclose(ends[1], place(rows[number][-1]), atol=1e-4)


def test_the_report_has_the_numbers_and_directions_of_the_csv(files, rows, told):
    page = files["report.html"].decode("utf-8")
    data = json.loads(re.search(r'type="application/json"[^>]*>(.*?)</script>', page, re.S)[1])
    shown = re.findall(r'<tr data-branch="(\d+)"><td class="swatch"></td><td>(\d+)[ <]', page)
    assert shown == [(str(k), str(k)) for k in range(1, 6)]
    for number, drawn in enumerate(data["branches"], start=1):
        assert drawn["branch"] == number
        np.testing.assert_allclose(drawn["points"][0], place(rows[number][0]), atol=0.01)
        np.testing.assert_allclose(drawn["points"][-1], place(rows[number][-1]), atol=0.01)
        assert drawn["arc"][0] == 0
    angles = {tuple(a["branches"]) for node in told["bifurcations"] for a in node["angles"]}
    assert {(int(a), int(b)) for a, b in re.findall(r"(\d+) and (\d+): \d+°", page)} == angles


def test_a_reconstruction_comes_from_its_inlets(result):
    again = from_inlets(result.tree)
    for made, same in zip(result.tree.branches, again.branches, strict=True):
        np.testing.assert_array_equal(made.points_mm, same.points_mm)
        assert (made.start, made.end) == (same.start, same.end)
