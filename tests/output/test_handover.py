"""The hand-over folder, read back by programs that are not ours."""

from __future__ import annotations

import dataclasses
import io
import itertools
import json

import numpy as np
import pytest

from gcar_deploy.measure import from_inlets
from gcar_deploy.output.handover import handover_files
from gcar_deploy.output.pressure_plot import pressure_svg
from gcar_deploy.tree.surface import Surface
from tests.flow.trees import drop_of, solved, stenosed, stenosed_fork
from tests.measure.test_blunt import CONUS, artery
from tests.measure.test_naming import left_tree


@pytest.fixture(scope="module")
def made():
    tree = stenosed_fork(50.0)
    drop = drop_of(tree)
    files, notes = handover_files(tree, drop)
    return tree, drop, files, notes


def vtp(data, tmp_path):
    vtk = pytest.importorskip("vtk")
    file = tmp_path / "data.vtp"
    file.write_bytes(data)
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(file))
    reader.Update()
    assert reader.GetErrorCode() == 0
    return reader.GetOutput()


def open_edges(data, *, manifold=False):
    vtk = pytest.importorskip("vtk")
    edges = vtk.vtkFeatureEdges()
    edges.SetInputData(data)
    edges.SetBoundaryEdges(not manifold)
    edges.SetNonManifoldEdges(manifold)
    edges.FeatureEdgesOff()
    edges.ManifoldEdgesOff()
    edges.Update()
    return edges.GetOutput()


def test_all_files_are_there_and_nothing_is_missing(made):
    _, _, files, notes = made
    assert set(files) == {
        "surface_open.vtp", "surface_open.stl", "centerline.vtp", "model_0d.json",
        "pressure.json", "pressure.svg",
    }  # fmt: skip
    assert notes == []


def test_the_surface_is_closed_by_its_caps_and_open_without_them(made, tmp_path):
    vtk = pytest.importorskip("vtk")
    data = vtp(made[2]["surface_open.vtp"], tmp_path)
    assert open_edges(data).GetNumberOfCells() == 0
    assert open_edges(data, manifold=True).GetNumberOfCells() == 0
    wall = vtk.vtkThreshold()
    wall.SetInputData(data)
    wall.SetInputArrayToProcess(0, 0, 0, vtk.vtkDataObject.FIELD_ASSOCIATION_CELLS, "ModelFaceID")
    wall.SetLowerThreshold(0.5)
    wall.SetUpperThreshold(1.5)
    skin = vtk.vtkGeometryFilter()
    skin.SetInputConnection(wall.GetOutputPort())
    parts = vtk.vtkPolyDataConnectivityFilter()
    skin.Update()
    parts.SetInputData(open_edges(skin.GetOutput()))
    parts.SetExtractionModeToAllRegions()
    parts.Update()
    assert parts.GetNumberOfExtractedRegions() == 3


def test_caps_have_names_and_are_flat_and_as_wide_as_the_vessel(made, tmp_path):
    from vtk.util.numpy_support import vtk_to_numpy

    tree, _, files, _ = made
    data = vtp(files["surface_open.vtp"], tmp_path)
    names = data.GetCellData().GetAbstractArray("FaceName")
    names = np.array([names.GetValue(k) for k in range(names.GetNumberOfValues())])
    ids = vtk_to_numpy(data.GetCellData().GetArray("ModelFaceID"))
    assert dict(zip(names, ids, strict=True)) == {
        "wall": 1, "inlet": 2, "outlet-1": 3, "outlet-2": 4
    }  # fmt: skip
    points = vtk_to_numpy(data.GetPoints().GetData())
    faces = vtk_to_numpy(data.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    ends = {"inlet": (0, 0), "outlet-1": (1, -1), "outlet-2": (2, -1)}
    for name, (branch, end) in ends.items():
        corners = points[faces[names == name]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = 0.5 * np.linalg.norm(normal, axis=1)
        way = normal.sum(axis=0) / np.linalg.norm(normal.sum(axis=0))
        flat = corners.reshape(-1, 3) @ way
        assert np.ptp(flat) < 1e-9
        own = tree.branches[branch]
        assert area.sum() == pytest.approx(np.pi * own.radius_mm[end] ** 2, rel=0.1)
        outward = own.tangents[end] * (-1 if end == 0 else 1)
        assert way @ outward > 0.95


def test_stl_has_one_named_solid_a_face(made):
    trimesh = pytest.importorskip("trimesh")
    text = made[2]["surface_open.stl"]
    solids = [line.split()[1] for line in text.decode().splitlines() if line.startswith("solid")]
    assert solids == ["wall", "inlet", "outlet-1", "outlet-2"]
    loaded = trimesh.load(io.BytesIO(text), file_type="stl")
    whole = trimesh.util.concatenate(list(loaded.geometry.values()))
    whole.merge_vertices(digits_vertex=5)
    assert whole.is_watertight and whole.is_winding_consistent and whole.volume > 0
    told = json.loads(made[2]["pressure.json"])["surface"]
    assert told["triangles"] == len(whole.faces)
    assert told["shortest_edge_mm"] == pytest.approx(whole.edges_unique_length.min(), rel=0.02)
    assert told["smallest_angle_deg"] == pytest.approx(
        np.degrees(whole.face_angles.min()), rel=0.02
    )
    assert told["shortest_edge_mm"] > 0.02 and told["smallest_angle_deg"] > 1


def crossings(surface: Surface) -> int:
    """Pairs of triangles without a common vertex of which one's edge runs through the other."""
    from scipy.spatial import cKDTree

    corners = surface.vertices_mm[surface.faces]
    middle = corners.mean(axis=1)
    size = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    # Most triangles are small; the few large ones, of the caps, are held against all.
    large = np.flatnonzero(size > np.median(size) * 2)
    pairs = np.concatenate([
        cKDTree(middle).query_pairs(4 * np.median(size), output_type="ndarray"),
        np.stack(np.meshgrid(large, np.arange(len(size))), -1).reshape(-1, 2),
    ])  # fmt: skip
    near = np.linalg.norm(middle[pairs[:, 0]] - middle[pairs[:, 1]], axis=1)
    pairs = pairs[near < size[pairs].sum(axis=1)]
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    shared = (surface.faces[pairs[:, 0], :, None] == surface.faces[pairs[:, 1], None, :]).any(
        (1, 2)
    )
    pairs = pairs[~shared]
    a = corners[pairs[:, 1]]
    e1, e2 = a[:, 1] - a[:, 0], a[:, 2] - a[:, 0]
    hits = np.zeros(len(pairs), bool)
    for k in range(3):
        start = corners[pairs[:, 0], k]
        way = corners[pairs[:, 0], (k + 1) % 3] - start
        # Möller and Trumbore's ray against triangle, held to the edge's length.
        p = np.cross(way, e2)
        det = np.einsum("ij,ij->i", e1, p)
        det = np.where(np.abs(det) < 1e-15, np.nan, det)
        s = start - a[:, 0]
        u = np.einsum("ij,ij->i", s, p) / det
        q = np.cross(s, e1)
        v = np.einsum("ij,ij->i", way, q) / det
        t = np.einsum("ij,ij->i", e2, q) / det
        hits |= (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)
    return int(hits.sum())


@pytest.mark.slow
def test_no_triangle_runs_through_another(made):
    from gcar_deploy.output.handover import artery_surface

    tree, drop, _, _ = made
    surface = artery_surface(tree, drop).surface
    assert crossings(surface) == 0
    # The check itself: one vertex pushed through the opposite wall.
    bent = surface.vertices_mm.copy()
    bent[len(bent) // 2] += [6.0, 6.0, 6.0]
    assert crossings(Surface(vertices_mm=bent, faces=surface.faces)) > 0


@pytest.mark.slow
def test_a_whole_tree_has_a_cap_at_every_end():
    tree = from_inlets(left_tree())
    drop = drop_of(tree)
    files, notes = handover_files(tree, drop)
    told = json.loads(files["pressure.json"])["surface"]
    outlets = [f"outlet-{k}" for k in range(1, len(drop.network.outlets) + 1)]
    assert told["faces"] == ["wall", "inlet", *outlets] and not notes
    found = solved(json.loads(files["model_0d.json"]))
    assert len(found) >= len(tree.branches)


@pytest.mark.slow
def test_an_end_inside_another_vessel_stays_round_and_that_is_said():
    import dataclasses

    from tests.tree.shapes import branch

    tree = stenosed_fork(0.0)
    stub = branch([[0, 0, -12.0], [0.6, 0, -11.5], [1.2, 0, -11.0]], 0.5, 4, 5)
    trunk = tree.branches[0]
    near = int(np.argmin(np.abs(trunk.points_mm[:, 2] + 12.0)))
    from gcar_deploy.tree.edit import part_of

    lower = dataclasses.replace(part_of(trunk, 0, near), start=0, end=4)
    upper = dataclasses.replace(part_of(trunk, near, len(trunk) - 1), start=4, end=1)
    nodes = np.concatenate([tree.nodes_mm, trunk.points_mm[[near]], stub.points_mm[[-1]]])
    stub = dataclasses.replace(
        stub, points_mm=stub.points_mm + trunk.points_mm[near] - stub.points_mm[0]
    )
    joined = dataclasses.replace(
        tree, nodes_mm=nodes, branches=(lower, upper, *tree.branches[1:], stub)
    )
    files, notes = handover_files(joined, drop_of(joined))
    told = json.loads(files["pressure.json"])["surface"]
    assert len(told["left_round"]) == 1 and any("stays round" in note for note in notes)
    assert told["left_round"][0] not in told["faces"]


def test_tracts_are_what_vmtk_expects(made, tmp_path):
    from vtk.util.numpy_support import vtk_to_numpy

    tree, drop, files, _ = made
    data = vtp(files["centerline.vtp"], tmp_path)
    cells = {
        name: vtk_to_numpy(data.GetCellData().GetArray(name))
        for name in ("CenterlineIds", "TractIds", "GroupIds", "Blanking", "BranchId")
    }
    points = vtk_to_numpy(data.GetPoints().GetData())
    assert set(cells["CenterlineIds"]) == {0, 1}
    for name in ("Radius", "MaximumInscribedSphereRadius"):
        radius = vtk_to_numpy(data.GetPointData().GetArray(name))
        assert radius.min() == pytest.approx(tree.radii().min(), rel=1e-6)
    assert (cells["Blanking"] == (cells["BranchId"] == 0)).all()
    for centerline in (0, 1):
        own = np.flatnonzero(cells["CenterlineIds"] == centerline)
        assert cells["TractIds"][own].tolist() == [0, 1, 2]
        assert cells["Blanking"][own].tolist() == [0, 1, 0]
        lines = []
        for cell in own:
            ids = data.GetCell(int(cell)).GetPointIds()
            lines.append(points[[ids.GetId(k) for k in range(ids.GetNumberOfIds())]])
        for first, second in itertools.pairwise(lines):
            np.testing.assert_allclose(first[-1], second[0], atol=1e-9)
        length = sum(np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in lines)
        outlet = drop.network.outlets[centerline]
        assert length == pytest.approx(
            tree.branches[0].length_mm + tree.branches[outlet].length_mm, rel=1e-6
        )
    # The trunk is one group, shared by both; so is the fork.
    assert len(set(cells["GroupIds"][cells["BranchId"] == 1])) == 1
    assert len(set(cells["GroupIds"][cells["Blanking"] == 1])) == 1


def test_the_0d_model_runs(made):
    _, drop, files, _ = made
    found = solved(json.loads(files["model_0d.json"]))
    inlet = found["branch1_seg0"]
    assert inlet[1] == pytest.approx(drop.assumed.aortic_pressure_pa * 10, rel=0.01)


def test_without_a_possible_flow_the_model_alone_is_left_out():
    tree = stenosed(85.0)
    files, notes = handover_files(tree, drop_of(tree))
    assert "model_0d.json" not in files and "surface_open.vtp" in files
    assert "no 0D model" in notes[0]


def test_axes_have_units(made):
    text = made[2]["pressure.svg"].decode()
    assert "mm from the ostium" in text and "Pd/Pa (dimensionless)" in text
    assert "ffr" not in text.lower()


def test_the_picture_names_the_branches_without_a_value_at_their_far_end(made):
    drop = made[1]
    first = dataclasses.replace(drop.vessels[0], withheld="")
    others = [
        dataclasses.replace(v, withheld="", doubtful=False, high=v.low) for v in drop.vessels[1:]
    ]
    whole = dataclasses.replace(drop, vessels=(first, *others))
    assert "far end" not in pressure_svg(whole)
    wide = dataclasses.replace(others[-1], withheld="too wide")
    told = pressure_svg(dataclasses.replace(whole, vessels=(first, *others[:-1], wide)))
    assert f"no value at the far end of branch {len(drop.vessels)}<" in told


def test_an_artery_that_begins_within_a_vessel_has_no_inlet_to_cut():
    tree = from_inlets(artery(CONUS))
    files, notes = handover_files(tree, drop_of(tree))
    assert any("no inlet to cut" in note for note in notes)
    model = json.loads(files["model_0d.json"])
    flows = [b["bc_values"]["Q"][0] for b in model["boundary_conditions"] if b["bc_type"] == "FLOW"]
    assert len(flows) == 2 and flows[0] > 5 * flows[1]  # the artery, and the conus branch
