"""gcar flow on a result folder: the same table as in it, files for solvers, clear refusals."""

from __future__ import annotations

import json
import shutil

import pytest

from gcar_deploy.cli.flow import flow
from gcar_deploy.flow import Assumption
from tests.cli.conftest import gcar
from tests.output.conftest import folder  # noqa: F401 - a fixture


@pytest.fixture
def copy(folder, tmp_path):  # noqa: F811
    return shutil.copytree(folder, tmp_path / "result")


def test_the_same_table_stands_in_the_result(copy):
    told = json.loads((copy / "result.json").read_text())["pressure"]
    found = json.loads(gcar("flow", copy, "--json").out)
    assert found["assumed" if "assumed" in found else "sentence"] == told["sentence"]
    for ours, theirs in zip(found["branches"], told["branches"], strict=True):
        assert ours["withheld"][:40] == theirs["withheld"][:40]
        assert ours["flow_ml_min"] == pytest.approx(theirs["flow_ml_min"], rel=1e-3)
        for key in ("pd_pa", "to_mm"):
            assert (ours[key] is None) == (theirs[key] is None)
            if ours[key] is not None:
                assert ours[key] == pytest.approx(theirs[key], rel=1e-3)


def test_for_people(copy):
    done = gcar("flow", copy, "--flow", "120", "--aortic-pressure", "80")
    assert done.code == 0 and "120 ml/min" in done.out and "Pa 80 mmHg" in done.out
    assert "ffr" not in done.out.lower()


@pytest.mark.slow
def test_files_for_solvers(copy, tmp_path):
    done = gcar("flow", copy, "--out", tmp_path / "model")
    assert done.code == 0 and done.out.splitlines()[0] == str(tmp_path / "model")
    names = {path.name for path in (tmp_path / "model").iterdir()}
    assert {"surface_open.vtp", "centerline.vtp", "pressure.svg", "manifest.json"} <= names
    assert gcar("flow", copy, "--out", tmp_path / "model").code == 2
    assert gcar("flow", copy, "--out", tmp_path / "model", "--force").code == 0


@pytest.mark.parametrize(
    ("option", "value", "says"),
    [("--velocity", "9", "velocity_m_s = 9"), ("--flow", "-3", "flow_ml_min = -3"),
     ("--aortic-pressure", "nan", "aortic_pressure_mmhg"), ("--flow-sigma", "2", "flow_sigma")],
)  # fmt: skip
def test_values_out_of_range(copy, option, value, says):
    done = gcar("flow", copy, option, value)
    assert done.code == 2 and says in done.err and done.err.count("\n") == 1


def test_help_tells_the_defaults_that_hold():
    told = {p.name: getattr(p, "show_default", None) for p in flow.params}
    shown = {name: text for name, text in told.items() if isinstance(text, str)}
    assert set(shown) == {"velocity_m_s", "aortic_pressure_mmhg"}
    assert shown == {name: f"{getattr(Assumption(), name):g}" for name in shown}


def test_flow_and_velocity_together_are_refused(copy):
    done = gcar("flow", copy, "--flow", "200", "--velocity", "0.9")
    assert done.code == 2 and "--velocity and --flow" in done.err


def test_a_folder_of_a_version_before_has_radii_alone(copy):
    told = json.loads((copy / "result.json").read_text())
    del told["files"]["diameters.csv"]
    (copy / "result.json").write_text(json.dumps(told))
    (copy / "diameters.csv").unlink()
    found = json.loads(gcar("flow", copy, "--json").out)
    assert len(found["branches"]) == len(told["tree"]["branches"])


def test_a_folder_that_is_no_result(tmp_path):
    done = gcar("flow", tmp_path)
    assert done.code == 2 and "result.json" in done.err


@pytest.mark.parametrize("table", ["centerline.csv", "diameters.csv"])
def test_an_altered_table_is_refused(copy, table):
    file = copy / table
    file.write_text(file.read_text().replace("1.", "2."))
    done = gcar("flow", copy)
    assert done.code == 2 and "not as it was written" in done.err
