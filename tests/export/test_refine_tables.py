"""Tables of the refinement: modes, calibration of sigma, cost curves."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("numba")

from gcar_deploy.config import RunOptions
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.selftest import tiny_case, tiny_tree
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.targets import make_targets
from gcar_export.scenes.trees import SyntheticTree, Vessel
from gcar_export.studies import refine_table as refining
from gcar_export.studies import sigma_table as sigma
from gcar_export.studies.cost_curves import Curve
from tests.export.label_files import write_tree


def test_exponent_of_a_power_law():
    sizes = (100, 300, 1000)
    curve = Curve("x", sizes, tuple(2e-4 * n**1.5 for n in sizes))
    assert curve.exponent == pytest.approx(1.5)


def test_modes_differ_in_the_centreline_alone():
    plain = refining.mode_options("paper", False)
    assert plain.paper.alpha == 1.0 and refining.mode_options("paper", True).paper.alpha == 0.5
    assert refining.mode_options("tube", False).tube.centreline_share == 0.0
    angiograms, _, _ = tiny_case()
    views = [extract_vessels(a, RunOptions().imaging) for a in angiograms]
    tube = refining.mode_options("tube", True).tube
    line, without = (
        make_targets(views, 0.0, o)[0] for o in (tube, refining.mode_options("tube", False).tube)
    )
    skeleton, mask = views[0].skeleton, views[0].mask
    assert (line.weight[skeleton] > 1).all() and (line.weight[~skeleton] == 0.5).all()
    assert line.weight[mask].sum() == pytest.approx(without.weight[mask].sum(), rel=0.01)


@pytest.mark.slow
def test_true_points_give_the_tree_back_and_noise_costs(tmp_path, monkeypatch):
    """A tree of its own, both noises, and the second call makes nothing again."""
    write_tree(tmp_path / "imagecas" / "5.label.nii.gz", 5)
    monkeypatch.setattr(refining, "MODES", refining.MODES[:1])
    calls = []
    arguments = (tmp_path, "paper", (), (0.0, 2.0), tmp_path / "fits")
    rows = refining.refine_rows(*arguments, on_fit=lambda: calls.append(0))
    dice = [row.measures["dsc"] for row in rows]
    assert dice[0] > 0.9 and dice[0] > dice[1] > 0.5
    assert all(set(row.measures) == set(refining.MEASURES) and row.cpu_s > 0 for row in rows)
    text = refining.table(rows, "paper")
    assert f"| tube | without | {100 * dice[0]:.1f} | {100 * dice[1]:.1f} |" in text
    monkeypatch.setattr(refining, "one_fit", None)
    assert refining.refine_rows(*arguments) == rows and len(calls) == 2


def test_errors_are_measured_from_the_true_centreline():
    made = tiny_tree()
    vessels = tuple(Vessel("v", "left", b.points_mm, b.radius_mm) for b in made.branches)
    truth = SyntheticTree(vessels, "right")
    shifted = Tree(
        nodes_mm=made.nodes_mm,
        branches=tuple(
            dataclasses.replace(b, sigma_mm=np.full(len(b), 0.5)) for b in made.branches
        ),
    )
    error, said = sigma.point_errors(shifted, truth)
    assert error.max() < 0.06 and (said == 0.5).all()


@pytest.mark.slow
def test_calibration_counts_trees_and_points():
    row = sigma.calibrate("clinical", "clean", "none", seed=3, trees=1)
    assert row.trees == 1 and (row.refused == 1 or row.points > 50)
    if not row.refused:
        assert row.mean_z2 > 0 and 0 <= row.coverage <= 1 and row.rmse_mm < sigma.GHOST_MM
        assert f"| {row.mean_z2:.2f} |" in sigma.table([row])


@pytest.mark.slow
def test_sigma_is_the_sum_of_its_parts():
    cells = sigma.calibrate_parts("paper", "clean", "multi", seed=3, trees=1)
    assert [cell.parts for cell in cells] == list(sigma.PARTS)
    fit, geometry, whole = cells
    # Each part widens sigma, so less lies outside of it; the errors stay what they are.
    assert fit.sigma_mm < geometry.sigma_mm < whole.sigma_mm
    assert fit.mean_z2 > geometry.mean_z2 > whole.mean_z2
    assert fit.coverage <= geometry.coverage <= whole.coverage
    assert fit.rmse_mm == whole.rmse_mm
    # In quadrature, by a road of its own: 0.45 of a pixel of 1.40625 mm at the isocentre.
    assert whole.sigma_mm**2 - geometry.sigma_mm**2 == pytest.approx((0.45 * 1.40625) ** 2)
