"""An evaluation that goes on in its folder: damaged rows, rows left out, what is drawn again."""

import json

import nibabel
import numpy as np
import pytest
from click.testing import CliRunner

from gcar_export.cli.main import main


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two cases by two methods that are quick."""
    folder = tmp_path_factory.mktemp("again")
    (folder / "data").mkdir()
    for k in (1, 2):
        volume = np.zeros((60, 60, 80), np.uint8)
        for z in range(5, 75):
            x = int(30 + 10 * np.sin(z / 10 + k))
            volume[x - 2 : x + 3, 28:33, z] = 1
        affine = np.diag([-0.7, -0.7, 0.7, 1])
        nibabel.save(nibabel.Nifti1Image(volume, affine), folder / "data" / f"{k}.nii.gz")
    ended = run(folder, "--methods", "visual_hull,hull")
    assert ended.exit_code == 0 and "not in these tables" not in ended.output, ended.output
    return folder


def run(folder, *words):
    given = ["evaluate", "--data", str(folder / "data"), "--out", str(folder / "out"), "--quiet"]
    return CliRunner().invoke(main, [*given, *words])


def table(folder):
    return {(entry["method"], entry["cases"])
            for entry in json.loads((folder / "out" / "summary.json").read_text())}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("text", ["", '{"case": "1"', "[]", '{"case": "1"}'])
def test_a_damaged_row_is_named_and_made_anew(made, caplog, text):
    file = made / "out" / "rows" / "paper-1-2-visual_hull.json"
    whole = json.loads(file.read_text())
    file.write_text(text)
    ended = run(made, "--methods", "visual_hull,hull")
    assert ended.exit_code == 0, ended.output
    assert f"{file} is damaged: made again" in caplog.text
    assert json.loads(file.read_text())["measures"] == whole["measures"]


@pytest.mark.parametrize(
    "verb",
    [("evaluate", "--methods", "visual_hull"), ("converge", "--methods", "nerp", "--steps", "1")],
)
def test_a_folder_that_holds_something_else_is_refused(made, tmp_path, verb):
    mine = tmp_path / "report.html"
    mine.write_text("mine")
    (tmp_path / "rows").mkdir()
    given = ["--data", str(made / "data"), "--out", str(tmp_path), "--quiet"]
    ended = CliRunner().invoke(main, [*verb, *given])
    assert ended.exit_code == 2 and f"{tmp_path} exists and holds no" in ended.output
    assert sorted(f.name for f in tmp_path.iterdir()) == ["report.html", "rows"]
    assert mine.read_text() == "mine" and not any((tmp_path / "rows").iterdir())


def test_rows_that_are_left_out_are_said(made):
    ended = run(made, "--methods", "visual_hull", "--cases", "1")
    assert "3 finished rows in" in ended.stderr
    assert "are not in these tables (case 2; method hull): name all" in ended.stderr
    assert table(made) == {("visual_hull", 1)}
    ended = run(made, "--methods", "visual_hull,hull")
    assert "not in these tables" not in ended.stderr
    assert table(made) == {("visual_hull", 2), ("hull", 2)}


def test_drawing_alone_heeds_what_is_named(made):
    assert run(made, "--methods", "visual_hull,hull").exit_code == 0
    assert run(made, "--draw-only", "--methods", "hull", "--cases", "2").exit_code == 0
    assert table(made) == {("hull", 1)}
    # Without a name all are drawn, whatever the methods are by default.
    assert run(made, "--draw-only").exit_code == 0
    assert table(made) == {("visual_hull", 2), ("hull", 2)}
    for option, value in (("methods", "fdk"), ("cases", "7"), ("views", "3"), ("protocol", "raw")):
        ended = run(made, "--draw-only", f"--{option}", value)
        assert ended.exit_code == 2 and f"{option} {value}: " in ended.output, ended.output
        assert "holds no such row" in ended.output
