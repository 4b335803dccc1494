"""Scores of predicted centres in closed form, the table on a real tree, memory of a process."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from gcar_deploy.errors import ModelError, UsageError
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.predict.center_predictor import open_predictor
from gcar_deploy.predict.kinds import read_predictor
from gcar_export.cli.main import main
from gcar_export.methods.predictor_process import peak_mib
from gcar_export.scenes.capsules import Capsules
from gcar_export.shipping.golden import golden_inputs
from gcar_export.studies import centers_table
from gcar_export.studies.centers import Truth, depth_error_px
from gcar_export.studies.centers_table import Cost, Row, open_models, table
from tests.conftest import data_dir
from tests.predict.test_hull import helix, scene
from tests.predict.test_view_centers import TINY, true_centers

GRID = Grid(center_mm=(0, 0, 0), size_mm=(40, 40, 40), shape=(40, 40, 40))


@pytest.fixture
def tube():
    """A straight vessel of 3 x 3 voxels along x, from -15.5 to 14.5 mm."""
    volume = np.zeros(GRID.shape, np.float32)
    volume[4:35, 19:22, 19:22] = 1
    return Truth.of(volume, GRID)


def test_scores_count_both_ways(tube):
    line = tube.centerline
    assert np.ptp(line[:, 0]) > 25 and np.ptp(line[:, 1]) < 1
    assert tube.scores(line, 1.5) == (1.0, 1.0)
    # Two voxels beside the rim: near nothing.
    assert tube.scores(line + np.array([0, 3.6, 0]), 1.5) == (0.0, 0.0)
    half = line[line[:, 0] < np.median(line[:, 0])]
    precision, recall = tube.scores(np.concatenate([half, half + np.array([0, 9, 0])]), 1.5)
    assert precision == pytest.approx(0.5) and recall == pytest.approx(0.5, abs=0.08)


def test_no_centre_is_no_precision_and_no_recall(tube):
    precision, recall = tube.scores(np.zeros((0, 3)), 1.5)
    assert np.isnan(precision) and recall == 0


def test_table_has_a_row_per_predictor_and_its_cost():
    rows = [Row("a", "paper", 0.5, 0.25, 90, 6.0), Row("b", "paper", 0.7, 0.75, 110, 8.0),
            Row("a", "multi", 1.0, 1.0, 100)]  # fmt: skip
    text = table(rows, [Cost("multi", 1.5, 1.25, 0.3, 0.2, 230.4)], "paper")
    assert "| multi (n=1) | 100.0 ± 0.0 | 100.0 ± 0.0 |" in text
    line = "| paper (n=2) | 60.0 ± 14.1 | 50.0 ± 35.4 | 50.0 .. 70.0 / 25.0 .. 75.0 | 100 "
    assert f"{line}| 7.0 (6.0 .. 8.0) |" in text
    assert text.index("| paper (n=2)") < text.index("| multi (n=1)")
    assert "| multi | 1.50 | 1.25 | 0.300 | 0.200 | 230 |" in text


def test_depth_that_is_off_by_so_much_is_said_to_be():
    """Every centre moved along its ray by three pixels: the median error is three pixels."""
    line = helix()
    tree = Capsules(line[:-1], line[1:], np.full(len(line) - 1, 1.6))
    views = scene(((0, 0), (90, 0)))
    alone = true_centers(views)
    for view in alone:
        view.ray_mm[:] += 3.0 * view.picture.pixel_mm
    predictor = SimpleNamespace(predict=lambda _: alone)
    seen = SimpleNamespace(views=[SimpleNamespace(carm=c, path_mm=p) for c, p in views])
    assert depth_error_px(predictor, seen, tree) == pytest.approx(3.0, abs=0.05)


def test_models_by_kind_or_path(monkeypatch, tmp_path):
    (model,) = open_models([str(TINY)])
    assert model.path == TINY and model.predictor.model.kind == "paper"
    with pytest.raises(ModelError, match=r"none\.onnx"):
        open_models([str(tmp_path / "none.onnx")])
    monkeypatch.setattr("gcar_deploy.models.spec.shipped_model_path", lambda name: None)
    with pytest.raises(UsageError, match="no paper model is installed"):
        open_models(["paper"])


def test_models_of_one_kind_have_rows_of_their_own(monkeypatch, tmp_path):
    own = tmp_path / "own.onnx"
    again = tmp_path / TINY.name
    for copy in (own, again):
        for suffix in (".onnx", ".json"):
            copy.with_suffix(suffix).write_bytes(TINY.with_suffix(suffix).read_bytes())
    models = open_models(["paper", str(own)])
    assert [model.name for model in models] == ["paper", "own.onnx"]
    assert {model.predictor.model.kind for model in models} == {"paper"}
    alike = open_models([str(TINY), str(again)])
    assert [model.name for model in alike] == [str(TINY), str(again)]
    with pytest.raises(UsageError, match="models: paper is named twice"):
        open_models(["paper", "paper"])
    monkeypatch.setattr(centers_table, "find_labels", lambda data, cases: [Path("a")])
    monkeypatch.setattr(centers_table, "read_label", lambda path: path)
    case = SimpleNamespace(name="a", truth=None, label=None, grid=GRID, angiograms=list)
    monkeypatch.setattr(centers_table, "make_case", lambda *_: case)
    monkeypatch.setattr(centers_table, "pose", lambda *_: None)
    monkeypatch.setattr(centers_table, "capsules_of", lambda _: None)
    monkeypatch.setattr(centers_table, "depth_error_px", lambda *_: 1.0)
    monkeypatch.setattr(centers_table, "_pair", lambda _: lambda: None)
    monkeypatch.setattr(centers_table, "_inference", lambda *_: lambda: None)
    monkeypatch.setattr(centers_table, "_feed", lambda *_: {})
    monkeypatch.setattr(centers_table, "peak_mib", lambda path, _: len(path.name))
    centers = {id(m.predictor): np.zeros((k + 1, 3)) for k, m in enumerate(models)}
    monkeypatch.setattr(centers_table, "predicted", lambda predictor, _: centers[id(predictor)])
    scores = SimpleNamespace(scores=lambda *_: (1.0, 1.0))
    monkeypatch.setattr(centers_table, "Truth", SimpleNamespace(of=lambda *_: scores))
    rows = centers_table.measure(Path(), "paper", models)
    assert [(row.name, row.centers) for row in rows] == [("paper", 1), ("own.onnx", 2)]
    costs = centers_table.cost(Path(), "paper", models)
    assert [cost.name for cost in costs] == ["paper", "own.onnx"]
    text = table(rows, costs, "paper")
    assert text.count("| paper ") == 2 and text.count("| own.onnx ") == 2


def test_a_process_with_only_the_predictor_stays_small():
    model = open_predictor(read_predictor(TINY)).model
    peak = peak_mib(TINY, golden_inputs(model))
    assert 20 < peak < 400


@pytest.mark.slow
def test_real_tree_through_the_command():
    args = ["centers-table", "--data", str(data_dir() / "data"), "--cases", "0001", "--no-cost"]
    done = CliRunner().invoke(main, args)
    assert done.exit_code == 0, done.output
    lines = {line.split("|")[1].split("(")[0].strip(): line for line in done.output.splitlines()
             if "(n=1)" in line}  # fmt: skip
    assert list(lines) == ["multi", "paper"]
    precision, recall = (float(lines["multi"].split("|")[k].split("±")[0]) for k in (2, 3))
    assert precision > 88 and recall > 88
    assert float(lines["paper"].split("|")[2].split("±")[0]) < precision
