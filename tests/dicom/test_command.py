"""DICOM through the command: with and without a geometry file, and what it refuses."""

import json

import cv2
import numpy as np
import pytest

pytest.importorskip("pydicom", reason="needs the dicom extra")

from gcar_deploy.selftest import tiny_case
from tests.cli.conftest import full_disk, gcar
from tests.dicom.files import tiny_runs


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two DICOM files of the small generated tree, attenuation with bright vessels."""
    folder = tmp_path_factory.mktemp("runs")
    tiny_runs(folder)
    for number, angiogram in enumerate(tiny_case()[0], start=1):
        cv2.imwrite(str(folder / f"view{number}.png"), angiogram.pixels.astype(np.uint16))
    return folder


def test_runs_need_no_geometry_file(runs, tmp_path):
    pair = runs / "run1.dcm", runs / "run2.dcm"
    done = gcar("run", *pair, "--out", tmp_path / "r", "--json")
    assert done.code == 0, done.err
    found = json.loads(done.out)
    assert found["tree"]["length_mm"] > 80 and found["views"][0]["name"] == "RAO 30 CAU 20"
    checked = gcar("validate", *pair, "--json")
    assert json.loads(checked.out)["would"] == "reconstruct"


def test_dicom_and_png_by_one_geometry_file(runs, tmp_path):
    written = gcar("geometry", "from-dicom", runs / "run1.dcm", runs / "run2.dcm")
    (tmp_path / "geom.json").write_text(written.out)
    mixed = runs / "run1.dcm", runs / "view2.png"
    done = gcar("run", *mixed, "--geom", tmp_path / "geom.json", "--out", tmp_path / "r")
    assert done.code == 0, done.err
    alone = gcar("run", *mixed, "--out", tmp_path / "s")
    assert alone.code == 2 and "view2.png is no DICOM file" in alone.err


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("--frame", "2"), 2, "--frame 2 is outside 1 .. 1 of run1.dcm"),
        (("--frame", "1,1,1"), 2, "3 frames for 2 DICOM files"),
        (("--frame", "last"), 2, "frame 'last' must be auto"),
        (("--sod", "10"), 2, "--sod"),
    ],
)
def test_options(runs, tmp_path, arguments, code, words):
    pair = runs / "run1.dcm", runs / "run2.dcm"
    done = gcar("run", *pair, "--out", tmp_path / "r", *arguments)
    assert done.code == code and words in done.err and not (tmp_path / "r").exists()


def test_a_damaged_run_is_3_and_one_line(runs, tmp_path):
    (tmp_path / "bad.dcm").write_bytes((runs / "run1.dcm").read_bytes()[:700])
    done = gcar("run", tmp_path / "bad.dcm", runs / "run2.dcm", "--out", tmp_path / "r")
    assert done.code == 3 and done.err.count("\n") == 1 and "bad.dcm" in done.err
    assert gcar("geometry", "from-dicom", runs / "run1.dcm").code == 2


def test_a_geometry_is_written_to_a_new_file(runs, tmp_path):
    file = tmp_path / "geom.json"
    pair = "geometry", "from-dicom", runs / "run1.dcm", runs / "run2.dcm"
    done = gcar(*pair, "--out", file)
    assert done.code == 0 and done.out == f"{file}\n" and file.read_text() == gcar(*pair).out
    assert "new file" in gcar(*pair, "--out", file).err
    lost = gcar(*pair, "--out", tmp_path / "absent" / "geom.json")
    assert lost.code == 2 and lost.err.startswith("gcar: error: ") and lost.out == ""


def test_a_full_disk_leaves_no_half_geometry(runs, tmp_path):
    with full_disk():
        done = gcar("geometry", "from-dicom", runs / "run1.dcm", runs / "run2.dcm",
                    "--out", tmp_path / "geom.json")  # fmt: skip
    assert done.code == 2 and "geom.json cannot be written" in done.err
    assert not list(tmp_path.iterdir())


def test_enhance(runs, tmp_path):
    picture = runs / "run1.dcm"
    done = gcar("enhance", picture, "--kind", "attenuation", "--polarity", "bright",
                "--out", tmp_path / "e")  # fmt: skip
    assert done.code == 0 and (tmp_path / "e" / "mask.png").is_file()
