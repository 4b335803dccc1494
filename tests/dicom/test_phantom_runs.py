"""Six real runs of a physical phantom (Vukicevic et al., Sci Rep 8:1711, 2018, Dataset I)."""

import json

import numpy as np
import pytest

pytest.importorskip("pydicom", reason="needs the dicom extra")

from gcar_deploy.config import DicomOptions
from gcar_deploy.dicom.scene import read_run, read_views
from gcar_deploy.errors import GeometryError
from gcar_deploy.geometry.scene import load_scene
from tests.cli.conftest import gcar
from tests.conftest import data_dir

WITHOUT_SPACING = ("IM1", "IM2", "IM3", "IM4")
SPACING = 0.390625


@pytest.fixture(scope="module")
def folder():
    root = data_dir()
    found = [f for f in (root / "phantom_xa", root / "data" / "phantom_xa") if f.is_dir()]
    if not found:
        pytest.skip("GCAR_DATA has no phantom_xa")
    return found[0]


@pytest.mark.parametrize("name", [*WITHOUT_SPACING, "IM7", "IM8"])
def test_every_run_loads(folder, name):
    run = read_run(folder / f"{name}.dcm", DicomOptions())
    assert run.pixels.shape == (512, 512) and np.ptp(run.pixels) > 100
    assert run.index + 1 == run.header.number("RepresentativeFrameNumber")
    rows, columns = np.nonzero(run.valid)
    # Shutter edges counted from 1 and shut themselves.
    edges = [
        run.header.number(f"Shutter{edge}Edge")
        for edge in ("LeftVertical", "RightVertical", "UpperHorizontal", "LowerHorizontal")
    ]
    left, right, upper, lower = edges
    found = columns.min() + 1, columns.max() + 1, rows.min() + 1, rows.max() + 1
    assert found == (left + 1, right - 1, upper + 1, lower - 1)


@pytest.mark.parametrize("name", WITHOUT_SPACING)
@pytest.mark.req("REQ-11")
def test_runs_without_spacing_ask_for_it(folder, name):
    pair = [folder / f"{name}.dcm", folder / "IM7.dcm"]
    with pytest.raises(GeometryError, match=f"{name}.dcm: ImagerPixelSpacing.*--pixel-spacing"):
        read_views(pair, DicomOptions())
    angiograms, _, _ = read_views(pair, DicomOptions(pixel_spacing_mm=SPACING))
    assert angiograms[0].carm.pixel_spacing_mm == angiograms[1].carm.pixel_spacing_mm


@pytest.mark.slow
def test_frames_of_a_phantom_are_those_that_a_run_takes(folder):
    """Nothing moves, so that no pair is better: not the one of the highest score is proposed."""
    paths = [folder / "IM7.dcm", folder / "IM8.dcm"]
    own = [read_run(path, DicomOptions()).index + 1 for path in paths]
    told = gcar("frames", *paths)
    assert told.code == 0, told.err
    assert told.out.count("no pair is better than another") == 2 and "margin" not in told.out
    assert told.out.splitlines()[-1] == f"gcar run ... --frame {own[0]},{own[1]}"


def test_the_command_asks_as_well(folder, tmp_path):
    asked = gcar("run", folder / "IM1.dcm", folder / "IM7.dcm", "--out", tmp_path / "r")
    assert asked.code == 4 and "--pixel-spacing" in asked.err.splitlines()[-1]
    assert not (tmp_path / "r").exists()


def test_geometry_from_the_headers(folder, tmp_path):
    written = gcar("geometry", "from-dicom", folder / "IM7.dcm", folder / "IM8.dcm")
    assert written.code == 0
    (tmp_path / "geom.json").write_text(written.out)
    scene = load_scene(tmp_path / "geom.json")
    first = scene.views[0].carm
    assert (first.primary_angle_deg, first.secondary_angle_deg) == (-29.3, 25.5)
    assert (first.sod_mm, first.sdd_mm) == (720, 976)
    shown = gcar("geometry", "show", tmp_path / "geom.json", "--json")
    found = json.loads(shown.out)
    assert found["pairs"][0]["separation_deg"] == pytest.approx(54.1, abs=0.05)
    assert "RAO 29 CRA 26" in gcar("geometry", "show", tmp_path / "geom.json").out


@pytest.mark.slow
def test_two_runs_make_a_tree(folder, tmp_path):
    done = gcar("run", folder / "IM7.dcm", folder / "IM8.dcm", "--out", tmp_path / "r", "--json")
    assert done.code == 0
    found = json.loads(done.out)
    assert found["tree"]["length_mm"] > 300
    assert any("estimated from their contrast" in note for note in found["notes"])
    assert all(view["coverage"] > 0.8 for view in found["views"])
