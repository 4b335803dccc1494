"""What is measured of a tree: once, and the same as measured piece by piece."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gcar_deploy import reconstruction
from gcar_deploy.config import LesionBorders
from gcar_deploy.measure.lumen import foreshortening
from gcar_deploy.measure.measured import measured, residuals
from gcar_deploy.tree.tree import empty_tree


def test_everything_is_measured_once_for_all_files_and_doors(result, tmp_path, monkeypatch):
    calls = []

    def counted(what):
        made = getattr(reconstruction, what)

        def once(*given):
            calls.append(what)
            return made(*given)

        monkeypatch.setattr(reconstruction, what, once)

    for what in ("measured", "unexplained", "versions"):
        counted(what)
    fresh = type(result).of(result, result.notes)
    fresh.save(tmp_path / "out")
    fresh.save(tmp_path / "again")
    told = json.loads(fresh.to_json())
    written = json.loads((tmp_path / "out" / "result.json").read_text())
    assert {**told, "files": written["files"]} == written and told == fresh.summary()
    assert fresh.names == fresh.measured.names
    assert sorted(calls) == ["measured", "unexplained", "unexplained", "versions"]


def test_a_summary_that_is_changed_changes_nothing_else(result):
    first = result.summary()
    first["tree"]["branches"].clear()
    first["status"] = "changed"
    assert result.summary()["tree"]["branches"] and result.summary()["status"] == result.status


def test_figures_belong_to_their_branch_and_view(result):
    made = measured(result.tree, result.views)
    assert made.hidden.shape == (len(result.tree.branches), len(result.views))
    for k, branch in enumerate(result.tree.branches):
        assert len(made.lumens[k].healthy_mm) == len(branch)
        alone = dataclasses.replace(result.tree, branches=(branch,))
        for v, view in enumerate(result.views):
            assert made.hidden[k, v] == foreshortening(alone, view.carm)[0]
    assert made.residual_mm.shape == (len(result.views), len(result.tree.points()))


def test_the_healthy_diameter_is_the_reference_at_the_narrowing(result):
    for branch, lumen in zip(result.tree.branches, result.measured.lumens, strict=True):
        if lumen.minimal_at_mm is None:
            assert np.isnan(lumen.healthy_mm).all()
            continue
        # Sections lie closer than points: the nearest point may be beyond the last that is told.
        told = np.flatnonzero(np.isfinite(lumen.healthy_mm))
        at = told[np.argmin(np.abs(branch.arc_mm[told] - lumen.minimal_at_mm))]
        assert abs(branch.arc_mm[at] - lumen.minimal_at_mm) < 1.5
        assert lumen.healthy_mm[at] == pytest.approx(lumen.reference_diameter_mm, rel=0.01)
        assert math.isnan(lumen.healthy_mm[0]) and math.isnan(lumen.healthy_mm[-1])


def test_residuals_are_distances_to_the_nearest_pixel_of_the_skeleton(result):
    view, points = result.views[0], result.tree.points()
    pixels, _ = view.carm.project(points)
    row, column = np.nonzero(view.skeleton)
    lookup = cKDTree(np.stack([column, row], axis=1))
    expected = lookup.query(np.rint(pixels))[0] * view.carm.pixel_at_isocenter_mm
    # The transform's 5 x 5 mask is right to 2 %.
    np.testing.assert_allclose(residuals(points, view), expected, rtol=0.03, atol=1e-6)
    far = points + 1000.0 * view.carm.axes[0]
    assert np.isnan(residuals(far, view)).all()


def test_a_marked_lesion_is_said_to_be_the_users(result):
    k = int(np.argmax([branch.length_mm for branch in result.tree.branches]))
    branch, carm = result.tree.branches[k], result.views[0].carm
    ends = branch.points_mm[[len(branch) // 3, 2 * len(branch) // 3]]
    proximal, distal = (tuple(pixel.tolist()) for pixel in carm.project(ends)[0])
    marks = (LesionBorders(view=1, proximal=proximal, distal=distal),)
    made = measured(result.tree, result.views, marks=marks)
    (lesion,) = (one for one in made.lumens[k].lesions if one.marked)
    first, last = lesion.lesion_mm
    said = f"of the user: borders of a lesion of branch {k + 1}, {first:.1f} - {last:.1f} mm"
    assert made.on_marks[0].split(";")[0] == said and last - first > 5


def test_an_empty_tree_has_nothing_to_measure(result):
    made = measured(empty_tree(), result.views)
    assert made.names == made.lumens == made.angles == () and made.further is None
    assert made.hidden.shape == (0, 2) and made.residual_mm.shape == (2, 0)
