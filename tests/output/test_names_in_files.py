"""Vessel names in everything that is written: with their probability, or not at all."""

from __future__ import annotations

import csv
import io
import json
from importlib import resources

import numpy as np
import pytest

from gcar_deploy.cli.info import names_of
from gcar_deploy.output.bundle import render_files
from gcar_deploy.output.report_data import scene_data
from tests.measure.test_naming import left_tree
from tests.output.made_results import with_tree

NAMES = ["LM", "LAD", "LCx", "LAD", None]


@pytest.fixture(scope="module")
def named(result):
    return with_tree(result, left_tree())


@pytest.fixture(scope="module")
def files(named):
    return render_files(named)


@pytest.mark.slow
def test_result_json(files):
    summary = json.loads(files["result.json"])
    jsonschema = pytest.importorskip("jsonschema")
    schema = resources.files("gcar_deploy.output").joinpath("result.schema.json").read_text()
    jsonschema.validate(summary, json.loads(schema))
    branches = summary["tree"]["branches"]
    assert [branch["name"] for branch in branches] == NAMES
    shares = [branch["name_confidence"] for branch in branches]
    assert shares[-1] is None and all(0.8 <= share <= 1 for share in shares[:-1])
    assert "0.8" in summary["reasons"]["/tree/branches/4/name"]
    assert names_of(branches).startswith("LM 15 mm (") and "LAD 110 mm" in names_of(branches)


def test_csv(files, named):
    rows = list(csv.DictReader(io.StringIO(files["centerline.csv"].decode("ascii"))))
    assert {(int(row["branch"]), row["name"]) for row in rows} == {
        (k, name or "") for k, name in enumerate(NAMES, start=1)
    }
    for row in rows:
        name = named.names[int(row["branch"]) - 1]
        told = "" if name is None else f"{name.confidence:.5f}"
        assert row["name_confidence"] == told


def test_vtp(files, named, tmp_path):
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    file = tmp_path / "line.vtp"
    file.write_bytes(files["centerline.vtp"])
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(file))
    reader.Update()
    cells = reader.GetOutput().GetCellData()
    texts = cells.GetAbstractArray("VesselName")
    assert [texts.GetValue(k) for k in range(5)] == [name or "" for name in NAMES]
    expected = [np.nan if name is None else name.confidence for name in named.names]
    np.testing.assert_allclose(vtk_to_numpy(cells.GetArray("NameConfidence")), expected)


def test_report(files, named):
    page = files["report.html"].decode("utf-8")
    percent = int(100 * named.names[0].confidence)
    assert f"<td>1 LM ({percent} %)</td>" in page and "<td>5</td>" in page
    assert [branch["name"] for branch in scene_data(named)["branches"]] == NAMES


def test_info_without_a_name():
    assert names_of([{"name": None}]) == "none is probable enough; branches have numbers"
    # Results of before there were names.
    assert "numbers" in names_of([{"length_mm": 3.0}])
