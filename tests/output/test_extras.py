"""surface.glb and surface.dcm, read back by trimesh and pydicom."""

from __future__ import annotations

import io
import json
import subprocess
import sys

import numpy as np
import pytest

from gcar_deploy.errors import UsageError
from gcar_deploy.output.bundle import SURFACE_EDGE_MM, render_files
from gcar_deploy.output.glb import glb_bytes
from gcar_deploy.tree.surface import lumen_surface, stl_bytes
from gcar_deploy.tree.tree import empty_tree
from tests.tree.shapes import enclosed_mm3, fork, tube


@pytest.fixture(scope="module")
def with_extras(result):
    pytest.importorskip("pydicom")
    return render_files(result, ("glb", "dicom-stl"))


def test_glb_is_the_surface_in_metres_with_the_head_up():
    trimesh = pytest.importorskip("trimesh")
    surface = lumen_surface(tube(length=30, radius=2, axis=(0, 0, 1)))
    scene = trimesh.load_scene(io.BytesIO(glb_bytes(surface)), file_type="glb")
    mesh = scene.to_mesh()
    assert mesh.is_watertight and len(mesh.faces) == len(surface.faces)
    assert mesh.volume == pytest.approx(enclosed_mm3(surface) * 1e-9, rel=1e-4)
    np.testing.assert_allclose(mesh.extents, [0.004, 0.034, 0.004], atol=2e-4)
    # A point 10 mm to the left, 20 mm behind, 30 mm towards the head.
    matrix = next(iter(scene.graph.transforms.edge_data.values()))["matrix"]
    np.testing.assert_allclose(matrix @ [10, 20, 30, 1], [0.010, 0.030, -0.020, 1], atol=1e-12)


def test_glb_normals_point_outwards():
    trimesh = pytest.importorskip("trimesh")
    surface = lumen_surface(tube(length=30, radius=2))
    data = glb_bytes(surface)
    length = int.from_bytes(data[12:16], "little")
    views = json.loads(data[20 : 20 + length])["bufferViews"]
    start = 20 + length + 8 + views[1]["byteOffset"]
    normals = np.frombuffer(data[start : start + views[1]["byteLength"]], "<f4").reshape(-1, 3)
    mesh = trimesh.Trimesh(surface.vertices_mm, surface.faces, process=False)
    assert (np.einsum("ij,ij->i", normals, mesh.vertex_normals) > 0.9).all()


def test_glb_without_a_tree_is_an_empty_scene():
    trimesh = pytest.importorskip("trimesh")
    data = glb_bytes(lumen_surface(empty_tree()))
    assert not trimesh.load_scene(io.BytesIO(data), file_type="glb").geometry


def test_dicom_stl_holds_the_very_stl_and_every_attribute_it_must(with_extras, result):
    pydicom = pytest.importorskip("pydicom")
    data = pydicom.dcmread(io.BytesIO(with_extras["surface.dcm"]))
    assert data.SOPClassUID == "1.2.840.10008.5.1.4.1.1.104.3"
    assert data.file_meta.MediaStorageSOPInstanceUID == data.SOPInstanceUID
    length = data.EncapsulatedDocumentLength
    assert data.EncapsulatedDocument[:length] == with_extras["surface.stl"]
    assert data.MIMETypeOfEncapsulatedDocument == "model/stl"
    assert data.MeasurementUnitsCodeSequence[0].CodeValue == "mm"
    # Type 1 of PS3.3 A.85: must be there and must not be empty.
    for keyword in (
        "Modality", "StudyInstanceUID", "SeriesInstanceUID", "SeriesNumber",
        "FrameOfReferenceUID", "Manufacturer", "ManufacturerModelName", "DeviceSerialNumber",
        "SoftwareVersions", "InstanceNumber", "BurnedInAnnotation", "ModelModification",
        "ModelMirroring", "ModelUsageCodeSequence",
    ):  # fmt: skip
        assert data[keyword].value, keyword
    # Type 2: must be there.
    for keyword in ("PatientName", "PatientID", "StudyDate", "ContentDate", "DocumentTitle"):
        assert keyword in data
    assert data.PatientName == ""


def test_extras_repeat_to_the_byte_and_are_listed(with_extras, result):
    again = render_files(result, ("dicom-stl", "glb"))
    for name in ("surface.glb", "surface.dcm"):
        assert again[name] == with_extras[name]
        assert name in json.loads(with_extras["result.json"])["files"]


@pytest.mark.slow
def test_unknown_extras_and_missing_libraries_are_told_before_any_work(result):
    with pytest.raises(UsageError, match="'step' is none of glb, dicom-stl"):
        render_files(result, ("step",))
    code = (
        "import sys; sys.modules['pydicom'] = None\n"
        "from gcar_deploy.output.bundle import check_extras\n"
        "check_extras(['dicom-stl'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "pip install 'gcar[dicom]'" in done.stderr


@pytest.mark.parametrize("tree", [fork(), tube(radius=0.5, axis=(1, 2, 3))])
def test_the_surface_is_fit_for_meshing(tree):
    """Closed, one piece, consistently wound, fine enough, and it never meets itself."""
    trimesh = pytest.importorskip("trimesh")
    data = stl_bytes(lumen_surface(tree, SURFACE_EDGE_MM))
    mesh = trimesh.load_mesh(io.BytesIO(data), file_type="stl")
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.is_volume
    assert mesh.body_count == 1 and mesh.volume > 0
    assert mesh.edges_unique_length.max() <= 0.8
    assert crossings(np.asarray(mesh.triangles)) == 0


def test_crossings_are_found():
    a = [[0, 0, 0], [2, 0, 0], [0, 2, 0]]
    b = [[0.5, 0.5, -1], [0.5, 0.5, 1], [0.6, 0.4, 1]]
    c = [[5, 5, 5], [6, 5, 5], [5, 6, 5]]
    assert crossings(np.array([a, b, c], float)) == 1
    assert crossings(np.array([a, c], float)) == 0


def crossings(triangles):
    """Pairs of triangles without a common corner of which one's edge pierces the other."""
    from scipy.spatial import cKDTree

    middle = triangles.mean(axis=1)
    reach = np.linalg.norm(triangles - middle[:, None], axis=2).max()
    pairs = cKDTree(middle).query_pairs(2 * reach, output_type="ndarray")
    first, second = triangles[pairs[:, 0]], triangles[pairs[:, 1]]
    gap = np.abs(first[:, :, None] - second[:, None]).sum(axis=3).min(axis=(1, 2))
    first, second = first[gap > 0], second[gap > 0]
    hit = np.zeros(len(first), bool)
    for one, other in ((first, second), (second, first)):
        for k in range(3):
            hit |= pierces(one[:, k], one[:, (k + 1) % 3], other)
    return int(hit.sum())


def pierces(start, stop, triangle):
    """(n,) whether each segment crosses the inside of its triangle (Moeller and Trumbore)."""
    a, b, c = triangle[:, 0], triangle[:, 1], triangle[:, 2]
    way = stop - start
    h = np.cross(way, c - a)
    det = np.einsum("ij,ij->i", b - a, h)
    usable = np.abs(det) > 1e-12
    inverse = 1.0 / np.where(usable, det, 1.0)
    s = start - a
    u = inverse * np.einsum("ij,ij->i", s, h)
    q = np.cross(s, b - a)
    v = inverse * np.einsum("ij,ij->i", way, q)
    t = inverse * np.einsum("ij,ij->i", c - a, q)
    eps = 1e-7
    return usable & (u > eps) & (v > eps) & (u + v < 1 - eps) & (t > eps) & (t < 1 - eps)
