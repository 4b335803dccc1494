"""Every file of the bundle read by a program that is not ours."""

from __future__ import annotations

import csv
import gzip
import hashlib
import io
import json
from importlib import resources

import numpy as np
import pytest

from gcar_deploy.engine import Engine
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.measure.measured import measured
from gcar_deploy.output.bundle import render_files
from gcar_deploy.output.tables import centerline_vtp, gaussians_ply
from gcar_deploy.output.volume import nifti_bytes
from gcar_deploy.plain import plain
from tests.conftest import ready_case


@pytest.mark.req("REQ-25")
def test_the_folder_holds_what_the_contract_says(folder):
    assert {p.name for p in folder.iterdir()} == {
        "result.json", "volume.nii.gz", "gaussians.npz", "gaussians.ply", "centerline.vtp",
        "centerline.csv", "diameters.csv", "surface.stl", "overlay_view1.png", "overlay_view2.png",
        "report.html",
    }  # fmt: skip


@pytest.mark.req("REQ-27")
def test_manifest_lists_every_other_file_with_its_hash(folder):
    listed = json.loads((folder / "result.json").read_text())["files"]
    others = {p.name for p in folder.iterdir()} - {"result.json"}
    assert set(listed) == others
    for name, entry in listed.items():
        data = (folder / name).read_bytes()
        assert len(data) == entry["bytes"]
        assert hashlib.sha256(data).hexdigest() == entry["sha256"]


@pytest.mark.slow
@pytest.mark.req("REQ-26")
def test_result_json_is_strict_and_follows_its_schema(folder):
    jsonschema = pytest.importorskip("jsonschema")

    def refuse(token):
        raise AssertionError(token)

    text = (folder / "result.json").read_text()
    summary = json.loads(text, parse_constant=refuse)
    schema = resources.files("gcar_deploy.output").joinpath("result.schema.json").read_text()
    jsonschema.Draft202012Validator.check_schema(json.loads(schema))
    jsonschema.validate(summary, json.loads(schema))
    assert summary["reasons"]["/model"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["P_0595", "P_0001", "C_0595", "M_0401"])
def test_results_of_real_trees_follow_the_schema(name):
    jsonschema = pytest.importorskip("jsonschema")
    case = ready_case(name)
    found = Engine(threads=1).reconstruct(
        [case / "view1.png", case / "view2.png"], case / "geom.json"
    )
    schema = resources.files("gcar_deploy.output").joinpath("result.schema.json").read_text()
    jsonschema.validate(json.loads(json.dumps(found.summary())), json.loads(schema))


@pytest.mark.req("REQ-26")
def test_every_null_has_a_reason(result):
    summary = result.summary()
    reasons = summary["reasons"]

    def walk(value, path):
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(inner, f"{path}/{key}")
        elif isinstance(value, list):
            for key, inner in enumerate(value):
                walk(inner, f"{path}/{key}")
        elif value is None:
            assert path in reasons, path

    summary.pop("options")
    walk(summary, "")


def test_plain_turns_what_is_not_finite_into_null_with_a_reason():
    reasons: dict[str, str] = {}
    value = {"a": np.float64("nan"), "b": [np.int64(3), float("inf")], "c": np.arange(2)}
    assert plain(value, "", reasons) == {"a": None, "b": [3, None], "c": [0, 1]}
    assert reasons == {"/a": "not finite", "/b/1": "not finite"}


def test_the_same_result_gives_the_same_bytes(result, files):
    again = render_files(result)
    assert files == again


@pytest.mark.req("REQ-32")
def test_volume_by_nibabel(result, folder):
    nibabel = pytest.importorskip("nibabel")
    image = nibabel.load(folder / "volume.nii.gz")
    assert image.get_data_dtype() == np.float32
    assert image.header.get_xyzt_units()[0] == "mm"
    np.testing.assert_array_equal(np.asarray(image.dataobj), result.volume)
    np.testing.assert_allclose(image.affine, result.grid.affine_ras(), atol=1e-5)
    np.testing.assert_allclose(image.get_qform(), image.get_sform(), atol=1e-4)
    # A voxel on the tree lies where the tree is, once LPS is turned into RAS.
    index = np.argwhere(result.volume > 0.9)
    ras = nibabel.affines.apply_affine(image.affine, index)
    gap = np.linalg.norm(ras[:, None] * (-1, -1, 1) - result.tree.points()[None], axis=2)
    assert gap.min(axis=1).max() < 3.0


def test_volume_is_what_nibabel_writes():
    nibabel = pytest.importorskip("nibabel")
    grid = Grid(center_mm=(1.5, -2, 3), size_mm=(18, 20, 22), shape=(9, 11, 13))
    volume = np.random.default_rng(0).random(grid.shape, np.float32)
    image = nibabel.Nifti1Image(volume, grid.affine_ras())
    image.header.set_xyzt_units("mm")
    image.header["descrip"], image.header["cal_max"] = b"gcar vessel occupancy 0..1", 1.0
    image.set_sform(grid.affine_ras(), code=1)
    image.set_qform(grid.affine_ras(), code=1)
    assert gzip.decompress(nifti_bytes(volume, grid)) == image.to_bytes()


def test_volume_bytes_hold_no_clock(result):
    data = nifti_bytes(result.volume, result.grid)
    assert data[4:8] == b"\0\0\0\0"


def test_npz_without_pickles(result, folder):
    with np.load(folder / "gaussians.npz", allow_pickle=False) as stored:
        np.testing.assert_array_equal(stored["means_mm"], result.gaussians.means_mm)
        np.testing.assert_array_equal(stored["scales_mm"], result.gaussians.scales_mm)
        assert "LPS" in str(stored["frame"])


def test_ply_by_plyfile(result):
    plyfile = pytest.importorskip("plyfile")
    data = plyfile.PlyData.read(io.BytesIO(gaussians_ply(result.gaussians)))
    vertex = data["vertex"].data
    g = result.gaussians
    means = np.stack([vertex[k] for k in "xyz"], axis=1)
    np.testing.assert_allclose(means, g.means_mm, atol=1e-4)
    scales = np.stack([vertex[f"scale_{k}"] for k in range(3)], axis=1)
    np.testing.assert_allclose(np.exp(scales), g.scales_mm, rtol=1e-5)
    turns = np.stack([vertex[f"rot_{k}"] for k in range(4)], axis=1)
    np.testing.assert_allclose(turns, g.quaternions_wxyz, atol=1e-6)
    share = 1 / (1 + np.exp(-vertex["opacity"].astype(float)))
    np.testing.assert_allclose(share, np.clip(g.intensity, 0.01, 0.99), atol=1e-5)
    red = 0.5 + 0.28209479 * vertex["f_dc_0"]
    assert np.all((red > 0) & (red < 1))


@pytest.mark.slow
@pytest.mark.req("REQ-32")
def test_centreline_by_vtk(result, folder):
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(folder / "centerline.vtp"))
    reader.Update()
    data = reader.GetOutput()
    assert reader.GetErrorCode() == 0
    assert data.GetNumberOfLines() == len(result.tree.branches)
    np.testing.assert_array_equal(vtk_to_numpy(data.GetPoints().GetData()), result.tree.points())
    for name in ("MaximumInscribedSphereRadius", "Radius"):
        found = vtk_to_numpy(data.GetPointData().GetArray(name))
        np.testing.assert_array_equal(found, result.tree.radii())
    sigma = np.concatenate([branch.sigma_mm for branch in result.tree.branches])
    np.testing.assert_array_equal(vtk_to_numpy(data.GetPointData().GetArray("Sigma")), sigma)
    fit = np.concatenate([branch.covariance_mm2[:, 0] for branch in result.tree.branches])
    found = vtk_to_numpy(data.GetPointData().GetArray("CovarianceFit"))
    np.testing.assert_array_equal(found, fit[:, [0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]])
    start = 0
    for number, branch in enumerate(result.tree.branches):
        ids = data.GetCell(number).GetPointIds()
        assert [ids.GetId(k) for k in range(ids.GetNumberOfIds())] == list(
            range(start, start + len(branch))
        )
        start += len(branch)


@pytest.mark.slow
def test_an_empty_tree_is_a_valid_file(result, tmp_path):
    vtk = pytest.importorskip("vtk")
    from gcar_deploy.tree.tree import empty_tree

    file = tmp_path / "empty.vtp"
    file.write_bytes(centerline_vtp(empty_tree(), measured(empty_tree(), result.views), ()))
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(file))
    reader.Update()
    assert reader.GetErrorCode() == 0 and reader.GetOutput().GetNumberOfPoints() == 0


def test_csv_rows_are_the_points(result, folder):
    with open(folder / "centerline.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    found = np.array([[float(row[f"{k}_mm"]) for k in "xyz"] for row in rows])
    np.testing.assert_allclose(found, result.tree.points(), atol=1e-4)
    np.testing.assert_allclose(
        [float(row["radius_mm"]) for row in rows], result.tree.radii(), atol=1e-4
    )


@pytest.mark.req("REQ-32")
def test_surface_by_vtk(result, folder):
    vtk = pytest.importorskip("vtk")
    reader = vtk.vtkSTLReader()
    reader.SetFileName(str(folder / "surface.stl"))
    reader.Update()
    edges = vtk.vtkFeatureEdges()
    edges.SetInputConnection(reader.GetOutputPort())
    edges.BoundaryEdgesOn()
    edges.NonManifoldEdgesOff()
    edges.FeatureEdgesOff()
    edges.ManifoldEdgesOff()
    edges.Update()
    assert edges.GetOutput().GetNumberOfCells() == 0, "the surface is open"
    mass = vtk.vtkMassProperties()
    mass.SetInputConnection(reader.GetOutputPort())
    mass.Update()
    r = np.concatenate([b.radius_mm[1:] for b in result.tree.branches])
    step = np.concatenate([np.diff(b.arc_mm) for b in result.tree.branches])
    assert mass.GetVolume() == pytest.approx(float((np.pi * r**2 * step).sum()), rel=0.15)


def test_overlays_are_pictures_with_colour(files):
    cv2 = pytest.importorskip("cv2")
    for number in (1, 2):
        data = np.frombuffer(files[f"overlay_view{number}.png"], np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        assert picture.shape[2] == 3 and min(picture.shape[:2]) >= 512
        spread = picture.max(axis=2).astype(int) - picture.min(axis=2)
        assert (spread > 100).sum() > 200, "no coloured line"
