"""The paper's predictor in the runtime: true rays, the true ONNX path, ways to be wrong."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gcar_deploy import Engine, RunOptions
from gcar_deploy.config import PaperOptions, PredictOptions, RefineOptions
from gcar_deploy.errors import ModelError, NumericalError
from gcar_deploy.predict.center_map import decode, encode_depth, net_picture
from gcar_deploy.predict.center_predictor import SingleViewPredictor, open_predictor
from gcar_deploy.predict.kinds import read_predictor
from gcar_deploy.predict.view_centers import known_views, placed_centers
from gcar_deploy.selftest import tiny_case

pytest.importorskip("gcar_export.scenes.render", reason="needs the export extra")
from tests.predict.test_hull import helix, scene

TINY = Path(__file__).parents[1] / "data" / "tiny-paper.onnx"
PAPER = RunOptions(
    predict=PredictOptions(predictor="paper"),
    refine=RefineOptions(refiner="paper", paper=PaperOptions(steps=60, control_every=20)),
)


def true_centers(views, error_mm=0.0, rng=None):
    """What a perfect single-view predictor would say: the helix's own depth in each cell."""
    from gcar_export.scenes.render import path_and_depth

    line = helix()
    out = []
    for carm, path in views:
        picture = net_picture(carm, path, 128)
        _, ray = path_and_depth(picture.carm, line[:-1], line[1:], np.full(len(line) - 1, 1.6))
        ray = np.where(np.isfinite(ray), ray, np.nanmedian(ray))
        if rng is not None:
            ray = ray + error_mm * rng.normal(size=ray.shape)
        answer = np.zeros((4, 128, 128))
        answer[0] = encode_depth(ray, picture)
        out.append(decode(answer, picture, 1))
    return out


def test_centres_of_both_views_stand_side_by_side_and_hold_the_vessel_once():
    views = scene(((0, 0), (90, 0)))
    alone = true_centers(views)
    placed = placed_centers(alone)
    assert placed.source == "paper" and len(placed) == sum(len(v.cell) for v in alone)
    np.testing.assert_array_equal(placed.points_mm, np.concatenate([v.points_mm for v in alone]))
    line = helix()
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    held = placed.confidence.sum() * placed.spacing_mm**3
    assert held == pytest.approx(np.pi * 1.6**2 * length, rel=0.15)
    # True depth: every centre is on the helix, whichever view it is from.
    off = cKDTree(line).query(placed.points_mm)[0]
    assert np.percentile(off, 95) < 1.6 + 2 * placed.spacing_mm


def test_a_centre_lies_on_its_true_ray_at_its_depth():
    """Closed form: source + distance times the unit ray through the cell, plus the offset."""
    carm, path = scene(((-30, -20), (45, 25)))[0]
    picture = net_picture(carm, path, 128)
    answer = np.zeros((4, 64, 64))
    answer[0] = 0.6
    answer[1:] = np.array([1.0, -2.0, 0.5])[:, None, None]
    found = decode(answer, picture, 2)
    t = np.linalg.norm(picture.carm.source_mm) + 0.1 * 160 * picture.pixel_mm
    np.testing.assert_allclose(found.ray_mm, t)
    u, v, w = picture.carm.axes
    shift = picture.pixel_mm * (1.0 * u - 2.0 * v + 0.5 * w)
    on_ray = found.points_mm - shift
    np.testing.assert_allclose(np.linalg.norm(on_ray - picture.carm.source_mm, axis=1), t)
    pixels, _ = picture.carm.project(on_ray)
    np.testing.assert_allclose(pixels, found.cell[:, ::-1] * 2 + 0.5, atol=1e-9)


def test_known_views_are_those_of_the_trained_directions():
    carms = [c for c, _ in scene(((0, 0), (90, 0), (45, 0), (3, 3), (-174, 6)))]
    paper = [[0, 0], [90, 0]]
    assert known_views(carms, paper) == [0, 1, 3]
    assert known_views(carms, []) == [0, 1, 2, 3, 4]
    assert known_views(carms[2:3], paper) == []


def test_one_set_of_centres_per_view_of_any_size():
    predictor = open_predictor(read_predictor(TINY))
    assert isinstance(predictor, SingleViewPredictor)
    views = scene(((-30, -20), (45, 25), (0, 30)))
    found = predictor.predict(views)
    assert len(found) == 3
    for view, (carm, _) in zip(found, views, strict=True):
        pixels, depth = carm.project(view.points_mm)
        assert len(view.points_mm) and (depth > 0).all()
        assert (pixels > -20).all() and (pixels < carm.rows + 20).all()


@pytest.mark.slow
def test_the_result_names_the_predictor(tmp_path):
    angiograms, grid, _ = tiny_case()
    result = Engine(TINY, options=PAPER).reconstruct(angiograms, grid)
    assert result.predictor == "paper" and result.model["name"] == "tiny-paper"
    assert result.status == "degraded"
    assert any("one view at a time" in said for said in result.quality.findings)
    # The kind is read off the model where none is asked for.
    unasked = dataclasses.replace(PAPER, predict=PredictOptions())
    assert Engine(TINY, options=unasked).reconstruct(angiograms, grid).predictor == "paper"


@pytest.mark.slow
def test_from_the_models_centres_through_the_optimisation_to_a_tree():
    angiograms, grid, _ = tiny_case()
    result = Engine(TINY, options=PAPER).reconstruct(angiograms, grid)
    assert (result.predictor, result.refiner, result.status) == ("paper", "paper", "degraded")
    assert result.losses[-1] < 0.2 * result.losses[0]
    assert result.tree.branches and len(result.gaussians) > 50


def test_a_model_of_the_other_kind_is_refused():
    multi = TINY.with_name("tiny.onnx")
    with pytest.raises(ModelError, match="is of kind multi, not paper"):
        Engine(multi, options=PAPER)
    with pytest.raises(ModelError, match="is of kind paper, not multi"):
        Engine(TINY, options=RunOptions(predict=PredictOptions(predictor="multi")))


@pytest.mark.slow
@pytest.mark.parametrize("wanted", ["auto", "multi", "paper"])
def test_without_a_model_the_hull_is_thinned_and_the_result_says_so(wanted, monkeypatch, tmp_path):
    monkeypatch.setattr("gcar_deploy.models.spec.resources.files", lambda _: tmp_path)
    angiograms, grid, _ = tiny_case()
    options = RunOptions(predict=PredictOptions(predictor=wanted))
    result = Engine(options=options).reconstruct(angiograms, grid)
    assert result.predictor == "hull" and result.model is None
    assert result.status == "degraded" and "no model was used" in " ".join(result.quality.findings)
    name = "gcp-paper" if wanted == "paper" else "gcp-multi"
    assert f"{name}.onnx is not installed" in " ".join(result.notes)


@pytest.fixture
def copy(tmp_path):
    for suffix in (".onnx", ".json"):
        shutil.copy(TINY.with_suffix(suffix), tmp_path / f"m{suffix}")
    return tmp_path / "m.onnx"


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("kind", "triple", "kind = 'triple'"),
        ("alpha", 0, "inputs.alpha = 0"),
        ("alpha", True, "inputs.alpha = True"),
        ("alpha", 5, "no multiple of inputs.alpha"),
        ("pixels", 10**6, "inputs.pixels = 1000000"),
        ("pose", "yes", "inputs.pose = 'yes'"),
        ("depth_pixels", 3, "inputs.depth_pixels = 3"),
    ],
)
def test_a_spec_that_does_not_fit_says_where(copy, key, value, message):
    file = copy.with_suffix(".json")
    spec = json.loads(file.read_text())
    (spec if key == "kind" else spec["inputs"])[key] = value
    file.write_text(json.dumps(spec))
    with pytest.raises(ModelError, match=message):
        read_predictor(copy)


def test_another_golden_answer_is_refused(copy):
    from gcar_export.shipping.golden import write_golden

    found = write_golden(copy)
    with np.load(found) as data:
        arrays = dict(data)
    arrays["output/centers"] = arrays["output/centers"] + 0.01
    np.savez(found, **arrays)
    with pytest.raises(ModelError, match="golden case"):
        open_predictor(read_predictor(copy))


class _Broken:
    """A session whose weights went wrong."""

    def run(self, names, feed, options):
        return [np.full((1, 4, 32, 32), np.nan, np.float32)]


def test_values_that_are_not_finite_are_an_error():
    untested = dataclasses.replace(read_predictor(TINY), golden=None)
    with pytest.raises(NumericalError, match="not finite"):
        open_predictor(untested, session=_Broken()).predict(scene(((-30, -20), (45, 25))))
