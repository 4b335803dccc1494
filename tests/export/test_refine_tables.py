"""Tables of the refinement: modes, calibration of sigma, cost curves."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("numba")

from gcar_deploy.config import RunOptions
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.selftest import tiny_case
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.targets import make_targets
from gcar_export.studies import refine_table as refining
from gcar_export.studies import sigma_table as sigma
from gcar_export.studies.cost_curves import REPEATS, Curve, curves
from tests.export.label_files import write_tree
from tests.tree.shapes import branch


def test_exponent_of_a_power_law():
    sizes = (100, 300, 1000)
    curve = Curve("x", sizes, tuple(2e-4 * n**1.5 for n in sizes))
    assert curve.exponent == pytest.approx(1.5)
    assert curve.interval == pytest.approx((1.5, 1.5), abs=1e-6)


def test_interval_of_an_exponent_holds_the_true_one_as_often_as_it_says():
    rng, sizes = np.random.default_rng(0), np.array([100, 300, 1000, 3000])
    held = 0
    for _ in range(400):
        seconds = 2e-4 * sizes**0.7 * np.exp(rng.normal(0, 0.2, len(sizes)))
        low, high = Curve("x", tuple(sizes), tuple(seconds)).interval
        held += low <= 0.7 <= high
    assert 0.92 <= held / 400 <= 0.98
    assert Curve("x", (1, 2), (1.0, 2.0)).interval == (-np.inf, np.inf)


def test_every_size_is_timed_in_every_round():
    asked = []
    timed = {name: {n: lambda n=n, name=name: asked.append((name, n)) for n in (1, 2)}
             for name in ("a", "b")}  # fmt: skip
    found = curves(timed=timed)
    assert asked == [("a", 1), ("a", 2), ("b", 1), ("b", 2)] * REPEATS
    assert [(c.name, c.sizes) for c in found] == [("a", (1, 2)), ("b", (1, 2))]


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


def test_errors_are_judged_by_the_ellipse_across_the_vessel():
    """A tree moved by (0.3, 0.4): by its covariance in depth alone, or in both axes."""
    line = np.stack([np.zeros(41), np.zeros(41), np.linspace(-20, 20, 41)], axis=1)
    truth = sigma.Patient(seen=lambda _: None, line_mm=line)
    parts = np.stack([np.diag([0.09, 0.04, 0.0]), np.diag([0.0, 0.12, 0.0])])
    moved = branch(line + np.array([0.3, 0.4, 0.0]), 1.0)
    moved = dataclasses.replace(moved, covariance_mm2=np.tile(parts, (41, 1, 1, 1)))
    made = Tree(nodes_mm=moved.points_mm[[0, -1]], branches=(moved,))
    error, z2, said = sigma.judged_points(made, truth)
    np.testing.assert_allclose(error, 0.5, atol=1e-6)
    np.testing.assert_allclose(z2[0], 0.5 * (0.3**2 / 0.09 + 0.4**2 / 0.04))
    np.testing.assert_allclose(z2[1], 0.5 * (0.3**2 / 0.09 + 0.4**2 / 0.16))
    np.testing.assert_allclose(said, [[0.3] * 41, [0.4] * 41])
    rough = dataclasses.replace(truth, line_sd_mm=0.4)  # of a label volume
    np.testing.assert_allclose(
        sigma.judged_points(made, rough)[1][0], 0.5 * (0.3**2 / 0.25 + 0.4**2 / 0.2)
    )


def test_what_is_relied_on_is_ok_and_no_called_ghost():
    def told(status, probability):
        points = np.zeros((len(probability), 3))
        ghosts = SimpleNamespace(points=(np.array(probability),))
        quality = SimpleNamespace(status=status, ghosts=ghosts)
        return SimpleNamespace(quality=quality, tree=SimpleNamespace(points=lambda: points))

    assert sigma.relied_on(told("ok", [0.1, 0.6, 0.49])).tolist() == [True, False, True]
    assert not sigma.relied_on(told("degraded", [0.1, 0.2])).any()


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
    fit, whole = cells
    # The geometry widens the ellipse, so less lies outside of it; the errors stay what they are.
    assert fit.sigma_mm < whole.sigma_mm
    assert fit.mean_z2 > whole.mean_z2 and fit.coverage <= whole.coverage
    assert fit.rmse_mm == whole.rmse_mm
