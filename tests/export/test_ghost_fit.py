"""Ghost fit and status table: a known model is found again, classes and rates are what they are."""

import json

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the export extra")

from gcar_deploy.config import QualityOptions
from gcar_deploy.quality import FIGURES, GhostModel
from gcar_deploy.quality.ghosts import shipped_model
from gcar_export.studies import ghost_fit, status_table
from gcar_export.studies.gate_rows import Attempt, Row
from gcar_export.studies.gate_table import expected_ghosts, replayed

GATES = QualityOptions()


def row(figures, off, dsc=0.8, kind="same", pictures="path length", number=0):
    whole = Attempt(
        disagreement=0.001, shift_mm=0.0, turn_deg=0.0, coverage=(0.99, 0.99),
        coverage_even=(0.99, 0.99), support=(1.0, 1.0),
        dsc=dsc, figures=tuple(map(tuple, figures)), length_mm=(8.0,) * len(figures),
        off=tuple(off),
    )  # fmt: skip
    return Row(
        population="1", tree=str(number), kind=kind, pictures=pictures, level=0.0, contrast=None,
        background=None, photons=None, whole=whole, parts=None, other_order=1.0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def known():
    """Rows drawn from a model, and the model."""
    rng = np.random.default_rng(5)
    weight = np.zeros(len(FIGURES))
    weight[:2] = -1.5, 0.8
    model = GhostModel(np.zeros(len(FIGURES)), np.ones(len(FIGURES)), weight, -1.0)
    rows = []
    for k in range(120):
        figures = rng.normal(size=(40, len(FIGURES)))
        off = (rng.random(40) < model.probability(figures)).astype(float)
        rows.append(row(figures, off, number=k))
    return rows, model


def test_a_known_model_is_found_again(monkeypatch, known):
    rows, model = known
    monkeypatch.setattr(ghost_fit, "OBSERVED_MM", 8.0)  # here each stretch is drawn by itself
    found = ghost_fit.fit(rows)
    raw = found.weight / found.sd
    np.testing.assert_allclose(raw, model.weight, atol=0.15)
    slope, intercept = ghost_fit.calibration(found, rows)
    assert slope == pytest.approx(1.0, abs=0.03) and intercept == pytest.approx(0.0, abs=0.03)
    assert ghost_fit.discrimination(found, rows) > 0.8
    for total, stated, true in ghost_fit.reliability(found, rows):
        assert true == pytest.approx(stated, abs=0.05) or total < 400


def test_a_model_that_states_too_much_shows(known):
    rows, model = known
    bold = GhostModel(model.mean, model.sd, 2 * model.weight, 2 * model.bias)
    assert ghost_fit.calibration(bold, rows)[0] == pytest.approx(0.5, abs=0.05)


def test_the_file_holds_what_was_fitted(known):
    rows, model = known
    held = json.loads(ghost_fit.as_json(model, ghost_fit.made_of(rows, 7, "abc")))
    assert [figure["name"] for figure in held["figures"]] == list(FIGURES)
    assert held["figures"][0]["weight"] == -1.5 and held["bias"] == -1.0
    assert "seed 7" in held["made_of"] and "120 path length" in held["made_of"]


def pair(share, dsc, **more):
    """A pair of which the shipped model expects so much in ghosts."""
    model = shipped_model()
    odds = np.log(share / (1 - share)) - model.bias
    # A little of each figure: none is as far from the usual as is cut off.
    figures = model.mean + model.sd * model.weight * odds / (model.weight @ model.weight)
    return row([figures], [0.0], dsc, **more)


def test_the_status_follows_the_share_that_is_expected_in_ghosts():
    gate = GATES.good_ghost_share
    assert expected_ghosts(pair(0.2, 0.8).whole) == pytest.approx(0.2)
    assert replayed(pair(0.9 * gate, 0.8), GATES) == "ok"
    assert replayed(pair(1.1 * gate, 0.8), GATES) == "degraded"


def test_the_rule_takes_the_largest_share_that_keeps_bad_pairs_out():
    good = [pair(share, 0.9, number=k) for k, share in enumerate(np.linspace(0.01, 0.3, 30))]
    wrong = [pair(share, 0.5, number=k) for k, share in enumerate(np.linspace(0.2, 0.5, 30))]
    chosen = status_table.chosen_share([*good, *wrong], GATES)
    assert 0.19 <= chosen <= 0.2
    false, true, area = status_table.roc([*good, *wrong])
    assert area > 0.9 and (np.diff(false) >= 0).all() and (np.diff(true) >= 0).all()
    assert status_table.chosen_share([pair(0.01, 0.1)], GATES) == GATES.good_ghost_share


def test_tables_and_pictures(tmp_path, known):
    rows = [pair(0.02, 0.9), pair(0.02, 0.6), pair(0.4, 0.5), pair(0.4, None, kind="two trees")]
    text = status_table.truth_table({"x": rows}, GATES)
    assert "| x | all | 4 | 1 / 0 / 0 | 1 / 2 / 0 | 50.0 |" in text
    status_table.draw({"x": rows}, GATES, tmp_path / "status.png")
    groups = {"fitted": known[0][:40], "other": known[0][40:]}
    assert "| other | path length | 80 |" in ghost_fit.summary_table(known[1], groups)
    assert ghost_fit.reliability_table(known[1], groups).count("\n") == 1 + 8
    ghost_fit.draw(known[1], groups, tmp_path / "ghosts.png")
    assert all(file.stat().st_size > 10_000 for file in tmp_path.iterdir())
    assert len(list(tmp_path.iterdir())) == 2
