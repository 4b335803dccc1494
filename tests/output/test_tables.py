"""Details of the tables beyond what ``test_files`` reads back."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import zipfile
from importlib import resources

import numpy as np
import pytest

from gcar_deploy.gaussians.gaussians import Gaussians
from gcar_deploy.output.bundle import render_files
from gcar_deploy.output.report import _jpeg, report_html
from gcar_deploy.output.report_data import scene_data
from gcar_deploy.output.tables import centerline_csv, centerline_vtp, gaussians_npz, gaussians_ply
from gcar_deploy.tree.tree import Branch, Tree
from tests.output.made_results import with_ghost, with_tree


def some_gaussians(n, sigma=None):
    rng = np.random.default_rng(0)
    return Gaussians(
        means_mm=rng.normal(size=(n, 3)), scales_mm=rng.uniform(0.2, 2, (n, 3)),
        quaternions_wxyz=rng.normal(size=(n, 4)), intensity=rng.uniform(0, 2, n), sigma_mm=sigma,
    )  # fmt: skip


def test_npz_is_lossless_and_holds_no_clock():
    g = some_gaussians(5, sigma=np.full((5, 3), np.nan))
    data = gaussians_npz(g)
    assert data == gaussians_npz(g)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        for name in ("means_mm", "scales_mm", "quaternions_wxyz", "intensity", "sigma_mm"):
            np.testing.assert_array_equal(stored[name], getattr(g, name))
    with np.load(io.BytesIO(gaussians_npz(some_gaussians(2)))) as stored:
        assert "sigma_mm" not in stored.files


def test_ply_without_a_gaussian_is_valid():
    plyfile = pytest.importorskip("plyfile")
    data = plyfile.PlyData.read(io.BytesIO(gaussians_ply(some_gaussians(0))))
    assert data["vertex"].count == 0 and not data.text


def test_vtp_cells(result, tmp_path):
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    file = tmp_path / "line.vtp"
    file.write_bytes(centerline_vtp(result.tree, result.measured, result.ghost_probability))
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(file))
    reader.Update()
    cells = reader.GetOutput().GetCellData()
    branches = result.tree.branches
    expected = {
        "BranchId": np.arange(1, len(branches) + 1),
        "Length": [branch.length_mm for branch in branches],
        "StartNode": [branch.start for branch in branches],
        "EndNode": [branch.end for branch in branches],
    }
    for name, values in expected.items():
        np.testing.assert_allclose(vtk_to_numpy(cells.GetArray(name)), values)


def test_csv_numbers_arcs_and_unknown_sigma(result):
    tree = result.tree
    hidden = dataclasses.replace(tree.branches[0], sigma_mm=np.full(len(tree.branches[0]), np.nan))
    tree = dataclasses.replace(tree, branches=(hidden, *tree.branches[1:]))
    told = result.measured, result.ghost_probability
    rows = list(csv.DictReader(io.StringIO(centerline_csv(tree, *told).decode("ascii"))))
    assert [int(row["branch"]) for row in rows] == list(tree.branch_index() + 1)
    assert {row["sigma_mm"] for row in rows if row["branch"] == "1"} == {""}
    last = [row for row in rows if row["branch"] == "1"][-1]
    assert float(last["arc_mm"]) == pytest.approx(hidden.length_mm, abs=1e-4)


def test_table_and_json_state_the_trees_own_numbers(result):
    written = centerline_csv(result.tree, result.measured, result.ghost_probability).decode("ascii")
    rows = list(csv.DictReader(io.StringIO(written)))
    own = {
        "radius_mm": result.tree.radii(),
        "sigma_mm": np.concatenate([b.sigma_mm for b in result.tree.branches]),
        "confidence": np.concatenate([b.confidence for b in result.tree.branches]),
        **dict(zip(("x_mm", "y_mm", "z_mm"), result.tree.points().T, strict=True)),
    }
    for name, values in own.items():
        np.testing.assert_allclose([float(row[name]) for row in rows], values, rtol=1e-4, atol=1e-5)
    for branch, told in zip(
        result.tree.branches, result.summary()["tree"]["branches"], strict=True
    ):
        assert told["mean_sigma_mm"] == pytest.approx(branch.sigma_mm.mean())


def test_probabilities_of_a_ghost_are_in_table_and_json(result):
    doubted = with_ghost(result)
    written = centerline_csv(doubted.tree, doubted.measured, doubted.ghost_probability)
    rows = list(csv.DictReader(io.StringIO(written.decode("ascii"))))
    expected = np.concatenate(doubted.ghost_probability)
    np.testing.assert_allclose([float(row["ghost_probability"]) for row in rows], expected)
    summary = doubted.summary()
    told = [branch["ghost_probability"] for branch in summary["tree"]["branches"]]
    assert told == pytest.approx(doubted.quality.ghosts.branches)
    (ghost,) = summary["ambiguity"]["probable_ghosts"]
    branch = doubted.tree.branches[ghost["branch"] - 1]
    assert ghost["end_mm"] == pytest.approx(0.5 * branch.length_mm)
    gap = np.linalg.norm(branch.points_mm - ghost["middle_mm"], axis=1)
    assert abs(branch.arc_mm[gap.argmin()] - 0.25 * branch.length_mm) < 2.0
    assert summary["ambiguity"]["ghost_share"] == 0.2


def test_unknown_ghosts_are_empty_fields_and_null_with_a_reason(result):
    written = centerline_csv(result.tree, result.measured, result.ghost_probability)
    rows = list(csv.DictReader(io.StringIO(written.decode("ascii"))))
    assert {row["ghost_probability"] for row in rows} == {""}
    summary = result.summary()
    assert summary["tree"]["branches"][0]["ghost_probability"] is None
    assert "two views" in summary["reasons"]["/tree/branches/0/ghost_probability"]
    assert summary["tree"]["parts_mm"][0] <= summary["tree"]["length_mm"]


def test_table_and_json_state_the_covariance_by_its_causes(result):
    """Fit and geometry add; the worst direction of the sum is sigma; depth and plane its axes."""
    written = centerline_csv(result.tree, result.measured, result.ghost_probability).decode("ascii")
    rows = list(csv.DictReader(io.StringIO(written)))
    fit, geometry = np.swapaxes(
        np.concatenate([branch.covariance_mm2 for branch in result.tree.branches]), 0, 1
    )
    told = {key: np.array([float(row[key]) for row in rows]) for key in rows[0] if "_mm" in key}
    names = ("xx", "xy", "xz", "xy", "yy", "yz", "xz", "yz", "zz")
    whole = np.stack([told[f"cov_{name}_mm2"] for name in names], 1).reshape(-1, 3, 3)
    np.testing.assert_allclose(whole, fit + geometry, atol=1e-5)
    for name, part in (("fit", fit), ("geometry", geometry)):
        largest = np.linalg.norm(part, 2, axis=(1, 2))
        np.testing.assert_allclose(told[f"sigma_{name}_mm"] ** 2, largest, atol=1e-4)
    np.testing.assert_allclose(told["sigma_mm"] ** 2, np.linalg.norm(whole, 2, axis=(1, 2)), 1e-3)
    branch = result.summary()["tree"]["branches"][0]
    own = np.array([row["branch"] == "1" for row in rows])
    assert branch["mean_sigma_fit_mm"] == pytest.approx(told["sigma_fit_mm"][own].mean(), rel=1e-3)
    # All of the variance is along a beam or across it, twice.
    rays = [result.tree.branches[0].points_mm - view.carm.source_mm for view in result.views]
    along = np.mean(
        [np.einsum("ni,nij,nj->n", r, whole[own], r) / np.sum(r**2, axis=1) for r in rays], axis=0
    )
    assert branch["mean_sigma_depth_mm"] == pytest.approx(np.sqrt(along).mean(), rel=1e-3)
    across = 0.5 * (np.trace(whole[own], axis1=1, axis2=2) - along)
    assert branch["mean_sigma_plane_mm"] == pytest.approx(np.sqrt(across).mean(), rel=1e-3)


def test_a_covariance_that_is_not_known_is_an_empty_field(result):
    hidden = dataclasses.replace(result.tree.branches[0], covariance_mm2=None)
    tree = dataclasses.replace(result.tree, branches=(hidden, *result.tree.branches[1:]))
    written = centerline_csv(tree, result.measured, result.ghost_probability)
    rows = list(csv.DictReader(io.StringIO(written.decode("ascii"))))
    assert {row["cov_xy_mm2"] == "" for row in rows if row["branch"] == "1"} == {True}
    assert {row["cov_xy_mm2"] == "" for row in rows if row["branch"] != "1"} <= {False}


def long_tree(branches=40, points=400):
    t = np.linspace(0, 100, points)
    line = np.stack([t, np.sin(t / 9), t * 0], axis=1)
    made = tuple(
        Branch(
            points_mm=line + k, radius_mm=np.full(points, 1.234567),
            sigma_mm=np.full(points, 0.123456), confidence=np.ones(points), start=0, end=1,
        )
        for k in range(branches)
    )  # fmt: skip
    return Tree(nodes_mm=np.stack([line[0], line[-1]]), branches=made)


@pytest.mark.slow
def test_report_stays_small_for_noisy_pictures_and_long_trees(result):
    tree = long_tree()
    long = with_tree(result, tree)
    noise = np.random.default_rng(0).normal(120, 12, (512, 512)).clip(0, 255).astype(np.uint8)
    picture = np.repeat(np.kron(noise, np.ones((2, 2), np.uint8))[..., None], 3, axis=2)
    assert len(report_html(long, long.summary(), [picture, picture])) < 500_000
    drawn = scene_data(long)["branches"]
    assert sum(len(branch["points"]) for branch in drawn) < 2100
    assert all(branch["arc"][-1] == pytest.approx(tree.branches[0].length_mm, abs=0.01)
               for branch in drawn)  # fmt: skip


def test_report_pictures_fit_their_budget():
    rng = np.random.default_rng(0)
    grey = np.repeat(np.repeat(rng.normal(120, 12, (512, 512)), 2, 0), 2, 1)
    picture = np.repeat(grey.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)
    assert len(_jpeg(picture, 120_000)) <= 120_000


def test_lumen_figures_are_in_the_summary_and_in_the_vtp(result, tmp_path):
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    s = np.linspace(0.0, 40.0, 81)
    # A healthy diameter of 3 mm narrowed to 1.5 mm in the middle, some 8 mm long.
    radius = 1.5 - 0.75 * np.exp(-0.5 * ((s - 20.0) / 2.5) ** 2)
    narrow = Branch(
        points_mm=np.stack([s, 0 * s, 0 * s], axis=1), radius_mm=radius,
        sigma_mm=np.full(81, 0.1), confidence=np.ones(81), start=0, end=1,
    )  # fmt: skip
    tree = Tree(nodes_mm=narrow.points_mm[[0, -1]], branches=(narrow,))
    narrowed = with_tree(result, tree)
    row = narrowed.summary()["tree"]["branches"][0]
    assert row["minimal_diameter_mm"] == pytest.approx(1.5, abs=1e-6)
    assert row["minimal_at_mm"] == pytest.approx(20.0)
    assert row["stenosis_percent"] == pytest.approx(50.0, abs=2.0)
    assert row["lesion_length_mm"] == pytest.approx(2 * 2.5 * np.sqrt(2 * np.log(5)), abs=1.0)
    file = tmp_path / "line.vtp"
    file.write_bytes(centerline_vtp(tree, narrowed.measured, narrowed.ghost_probability))
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(file))
    reader.Update()
    cells = reader.GetOutput().GetCellData()
    for name, key in (
        ("MinimalDiameter", "minimal_diameter_mm"), ("StenosisPercent", "stenosis_percent"),
        ("ReferenceDiameter", "reference_diameter_mm"), ("LesionLength", "lesion_length_mm"),
    ):  # fmt: skip
        assert vtk_to_numpy(cells.GetArray(name))[0] == pytest.approx(row[key])


def test_every_lesion_is_told_and_what_narrows_for_good_beside_them(result):
    jsonschema = pytest.importorskip("jsonschema")
    s = np.linspace(0.0, 60.0, 121)
    radius = np.interp(
        s,
        (0, 8, 11, 14, 20, 23, 26, 40, 41, 60),
        (1.8, 1.8, 0.7, 1.8, 1.8, 0.9, 1.8, 1.8, 0.8, 0.7),
    )
    line = Branch(
        points_mm=np.stack([s, 0 * s, 0 * s], axis=1), radius_mm=radius,
        sigma_mm=np.full(121, 0.1), confidence=np.ones(121), start=0, end=1,
    )  # fmt: skip
    told = with_tree(result, Tree(nodes_mm=line.points_mm[[0, -1]], branches=(line,)))
    summary = told.summary()
    schema = resources.files("gcar_deploy.output").joinpath("result.schema.json").read_text()
    jsonschema.validate(summary, json.loads(schema))
    (row,) = summary["tree"]["branches"]
    first, second = row["lesions"]
    assert (first["minimal_at_mm"], second["minimal_at_mm"]) == pytest.approx((11, 23), abs=0.5)
    for key in ("minimal_diameter_mm", "minimal_at_mm", "stenosis_percent", "lesion_mm"):
        assert first[key] == row[key]
    assert row["narrows_to_mm"] == pytest.approx(1.4, abs=0.1)
    page = render_files(told)["report.html"].decode("utf-8")
    share = f"{first['stenosis_percent']:.0f} %, {second['stenosis_percent']:.0f} %"
    assert f"<td>{share}; narrows to {row['narrows_to_mm']:.2f} mm without recovery</td>" in page
    (branch,) = scene_data(told)["branches"]
    assert branch["further"] == [pytest.approx(second["lesion_mm"], abs=0.06)]


def test_a_fork_tells_its_angles_and_a_short_branch_why_it_says_nothing(result):
    from tests.tree.shapes import branch

    stub = branch([[0, 0, 0], [0, 0, 1.0]], 1.5, 1, 3)
    lines = [branch([[-20, 0, 0], [0, 0, 0]], 1.5), branch([[0, 0, 0], [20, 0, 0]], 1.5, 1, 2)]
    nodes = np.array([[-20, 0, 0], [0, 0, 0], [20, 0, 0], [0, 0, 1.0]])
    tree = Tree(nodes_mm=nodes, branches=(*lines, stub))
    summary = with_tree(result, tree).summary()
    (node,) = summary["tree"]["bifurcations"]
    assert node["node"] == 1 and node["position_mm"] == [0, 0, 0]
    found = {tuple(a["branches"]): a["angle_deg"] for a in node["angles"]}
    assert found == pytest.approx({(1, 2): 180.0, (1, 3): 90.0, (2, 3): 90.0})
    assert "too short" in summary["reasons"]["/tree/branches/2/stenosis_percent"]
