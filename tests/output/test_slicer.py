"""The scene for 3D Slicer: read by an XML parser, by vtk, and by Slicer's own libraries."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import xml.etree.ElementTree as ET
from urllib.parse import unquote

import numpy as np
import pytest

from tests.cli.conftest import full_disk, gcar

#: a Python with slicer-core, which wants a vtk of its own
SLICER_PYTHON = os.environ.get("GCAR_SLICER_PYTHON")
_LOAD = """
import json, sys, slicer
scene, logic = slicer.vtkMRMLScene(), slicer.vtkMRMLColorLogic()
logic.SetMRMLScene(scene); logic.AddDefaultColorNodes(); scene.SetURL(sys.argv[1])
assert scene.Import()
out = {}
for kind in ("vtkMRMLScalarVolumeNode", "vtkMRMLModelNode"):
    for k in range(scene.GetNumberOfNodesByClass(kind)):
        node = scene.GetNthNodeByClass(k, kind); look = node.GetDisplayNode()
        data = node.GetImageData() if "Volume" in kind else node.GetPolyData()
        bounds = [0.0] * 6; node.GetRASBounds(bounds)
        colours = look.GetColorNode()
        out[node.GetName()] = {"points": data.GetNumberOfPoints(), "ras": bounds,
            "color": look.GetColor(), "opacity": look.GetOpacity(),
            "by": look.GetActiveScalarName() if "Model" in kind else None,
            "shown": bool(look.GetScalarVisibility()),
            "colours": colours and colours.GetName()}
print("FOUND" + json.dumps(out))
"""


def nodes_of(file):
    return list(ET.parse(file).getroot())  # noqa: S314 - our own


@pytest.fixture(scope="module")
def scene(result, tmp_path_factory):
    """The scene beside a folder with an awkward name."""
    folder = result.save(tmp_path_factory.mktemp("slicer") / "Müller's 50% <a> & b")
    done = gcar("slicer", folder)
    assert done.code == 0, done.err
    return folder.with_name(folder.name + ".mrml"), folder


def test_every_file_and_every_reference_is_there(scene):
    file, folder = scene
    nodes = nodes_of(file)
    ids = [node.get("id") for node in nodes]
    assert len(set(ids)) == len(nodes) == 9
    files = [file.parent / unquote(node.get("fileName")) for node in nodes if node.get("fileName")]
    assert sorted(files) == sorted(
        folder / name for name in ("volume.nii.gz", "surface.stl", "centerline.vtp")
    )
    told = [pair.split(":")[1] for node in nodes
            for pair in (node.get("references") or "").split(";") if pair]  # fmt: skip
    assert len(told) == 6 and set(told) < set(ids)


def test_what_is_told_of_the_files_is_true(scene):
    """The array that gives the colours is a whole number a line; the surface fits its place."""
    vtk = pytest.importorskip("vtk")
    file, folder = scene
    lines = next(n for n in nodes_of(file) if n.get("activeScalarName"))
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(folder / "centerline.vtp"))
    reader.Update()
    branches = reader.GetOutput().GetCellData().GetArray(lines.get("activeScalarName"))
    assert [branches.GetValue(k) for k in range(branches.GetNumberOfValues())] == list(
        range(1, reader.GetOutput().GetNumberOfCells() + 1)
    )
    stl = vtk.vtkSTLReader()
    stl.SetFileName(str(folder / "surface.stl"))
    stl.Update()
    line, surface = reader.GetOutput().GetBounds(), stl.GetOutput().GetBounds()
    # The lumen holds its centreline.
    assert all(surface[2 * k] < line[2 * k] and line[2 * k + 1] < surface[2 * k + 1]
               for k in range(3))  # fmt: skip


def test_nothing_is_overwritten_unasked(scene, tmp_path):
    file, folder = scene
    before = file.read_bytes()
    done = gcar("slicer", folder)
    assert done.code == 2 and "add --force" in done.err
    assert gcar("slicer", folder, "--force").code == 0 and file.read_bytes() == before
    assert gcar("slicer", folder, "--out", tmp_path / "s.xml").code == 2
    assert gcar("slicer", folder, "--out", tmp_path / "s.mrml").code == 0
    names = [n.get("fileName") for n in nodes_of(tmp_path / "s.mrml")]
    told = [tmp_path / unquote(name) for name in names if name]
    assert len(told) == 3 and all(path.is_file() for path in told)
    assert gcar("slicer", tmp_path).code == 2


def test_a_full_disk_leaves_the_scene_that_was_there(scene, tmp_path):
    file = tmp_path / "s.mrml"
    file.write_text("old")
    with full_disk():
        done = gcar("slicer", scene[1], "--out", file, "--force")
    assert done.code == 2 and "cannot be written" in done.err
    assert file.read_text() == "old" and list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("name", ["volume.nii.gz", "surface.stl", "centerline.vtp"])
def test_a_file_that_is_not_as_it_was_written_is_refused(scene, tmp_path, name):
    folder = shutil.copytree(scene[1], tmp_path / "result")
    (folder / name).write_bytes(b"abc")
    done = gcar("slicer", folder)
    assert done.code == 2 and f"{name} is not as it was written" in done.err
    (folder / name).unlink()
    done = gcar("slicer", folder)
    assert done.code == 2 and f"{name} no such file" in done.err
    assert not (tmp_path / "result.mrml").exists()


@pytest.mark.skipif(SLICER_PYTHON is None, reason="GCAR_SLICER_PYTHON names no Python with slicer")
def test_slicer_itself_opens_it(scene, result):
    file, _ = scene
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    told = subprocess.run(
        [SLICER_PYTHON, "-c", _LOAD, str(file)], capture_output=True, text=True, env=clean,
        check=False,
    )  # fmt: skip
    lines = told.stdout.splitlines()
    assert told.returncode == 0 and "ERR|" not in told.stderr, told.stderr
    found = json.loads(next(line for line in lines if line.startswith("FOUND"))[5:])
    volume, lumen, line = (next(v for k, v in found.items() if k.endswith(name))
                           for name in ("occupancy", "lumen", "centreline"))  # fmt: skip
    assert volume["points"] == result.volume.size and volume["colours"] == "Grey"
    points = result.tree.points() * [-1, -1, 1]
    assert line["points"] == len(points)
    ends = np.stack([points.min(0), points.max(0)], axis=1).reshape(-1)
    np.testing.assert_allclose(line["ras"], ends, atol=1e-3)
    assert (line["by"], line["shown"], line["colours"]) == ("BranchId", True, "RandomIntegers")
    assert lumen["opacity"] == 0.45 and lumen["color"] == [0.84, 0.37, 0.0]
    assert all(lumen["ras"][2 * k] < ends[2 * k] for k in range(3))
