"""The table's own arithmetic on trees whose errors are known beforehand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

pytest.importorskip("numba")
from gcar_deploy.engine import Engine
from gcar_deploy.tree.tree import Tree
from gcar_export.scenes.protocols import clinical_geometry
from gcar_export.scenes.stenosis_cases import (
    StenosisCase,
    Tube,
    generated_tubes,
    label_tubes,
    pictures,
    with_stenosis,
)
from gcar_export.studies.lumen_table import compare, measure_case, point_graph, table
from tests.conftest import data_dir
from tests.tree.shapes import branch, fork


@pytest.fixture
def case():
    s = np.arange(0, 80.1, 0.5)
    straight = Tube("a", np.stack([s - 40, 0 * s, 0 * s], axis=1), np.full(len(s), 1.5))
    made = with_stenosis("straight", (straight,), np.random.default_rng(0))
    assert made is not None
    return made


def tree_of(case, **change):
    lines = [branch(v.points_mm, v.radius_mm, 2 * k, 2 * k + 1) for k, v in enumerate(case.vessels)]
    nodes = np.concatenate([v.points_mm[[0, -1]] for v in case.vessels])
    return Tree(nodes_mm=nodes, branches=tuple(dataclasses.replace(b, **change) for b in lines))


def test_a_stenosis_is_as_severe_as_it_says(case):
    lesion, vessel = case.lesion, case.vessels[0]
    assert 30 <= lesion.percent <= 70
    assert lesion.minimal_diameter_mm == pytest.approx(3.0 * (1 - lesion.percent / 100))
    assert 2 * vessel.radius_mm.min() == pytest.approx(lesion.minimal_diameter_mm, abs=0.02)
    outside = np.abs(vessel.arc_mm - lesion.middle_mm) > lesion.length_mm / 2
    np.testing.assert_allclose(vessel.radius_mm[outside], 1.5)


def test_the_narrow_core_is_drawn_as_narrow_as_it_says():
    """Points 1 mm apart, as the generator has them: pieces so long would fill the core."""
    (first, second), _, _ = clinical_geometry(2)
    across_both = np.cross(first.source_mm, second.source_mm)
    across_both /= np.linalg.norm(across_both)
    s = np.arange(-40, 40.1, 1.0)
    straight = Tube("a", s[:, None] * across_both, np.full(len(s), 2.0))
    made = with_stenosis("straight", (straight,), np.random.default_rng(0), 60.0)
    middle = (made.lesion.middle_mm - 40) * across_both
    for picture in pictures(made)[0]:
        column, row = np.rint(picture.carm.project(middle[None])[0][0]).astype(int)
        path = picture.pixels * picture.intensity.mm_per_count
        assert path[row, column] == pytest.approx(1.6, abs=0.08)


def test_the_truth_has_no_error(case):
    row = compare(case, tree_of(case))
    assert row.mld_error_mm == pytest.approx(0, abs=0.02)
    assert row.stenosis_error == pytest.approx(0, abs=3)
    assert (row.radius_error_mm == 0).all() and row.length_errors == pytest.approx((0,), abs=1e-6)
    assert (row.branches, row.found) == (1, 1)


def test_errors_are_reconstruction_minus_truth(case):
    wide = tree_of(case, radius_mm=case.vessels[0].radius_mm + 0.2)
    row = compare(case, wide)
    np.testing.assert_allclose(row.radius_error_mm, 0.2)
    assert row.mld_error_mm == pytest.approx(0.4, abs=0.02) and row.stenosis_error < -1
    away = tree_of(case, points_mm=case.vessels[0].points_mm + np.array([0, 0, 3.0]))
    row = compare(case, away)
    assert row.mld_error_mm is None and row.found == 0 and row.branches == 1
    text = table([row, compare(case, wide)])
    assert "1 of 2 branches" in text and "not found in 1" in text


def test_lengths_run_along_the_tree_through_its_nodes():
    from scipy.sparse.csgraph import dijkstra

    tree = fork()
    trunk, left, _ = tree.branches
    reach = dijkstra(point_graph(tree), directed=False, indices=0)
    end_of_left = len(trunk) + len(left) - 1
    assert reach[end_of_left] == pytest.approx(trunk.length_mm + left.length_mm, abs=1e-6)
    whole = Tube("w", np.concatenate([trunk.points_mm, left.points_mm[1:]]), np.full(49, 1.5))
    lesion = dataclasses.replace(
        with_stenosis("f", (whole,), np.random.default_rng(1)).lesion, vessel=0
    )
    row = compare(StenosisCase("f", (whole,), lesion), tree)
    assert row.length_errors == pytest.approx((0,), abs=1e-6)


@pytest.mark.slow
def test_a_generated_tree_from_pictures_to_row():
    case = with_stenosis("g", generated_tubes(9_000_000), np.random.default_rng(0))
    assert case is not None
    row = measure_case(Engine(), case)
    assert row.status in ("ok", "degraded") and row.branches >= 2
    assert np.median(np.abs(row.radius_error_mm)) < 0.5


@pytest.mark.slow
def test_a_label_volume_becomes_vessels():
    found = sorted(data_dir().glob("**/imagecas/*.label.nii.gz"))
    if not found:
        pytest.skip("no imagecas/ in the data folder")
    path = found[0]
    vessels = label_tubes(path)
    length = sum(v.arc_mm[-1] for v in vessels)
    assert 150 < length < 1500
    assert 0.5 < np.median(np.concatenate([v.radius_mm for v in vessels])) < 2.5
    assert np.abs(np.concatenate([v.points_mm for v in vessels])).max() < 100
