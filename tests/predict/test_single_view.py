"""The single-view predictor in the runtime: the true ONNX path, merging, ways to be wrong."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from gcar_deploy import Engine, RunOptions
from gcar_deploy.config import CandidateOptions, PredictOptions
from gcar_deploy.errors import ModelError, NumericalError
from gcar_deploy.predict.center_map import decode, encode_depth, net_picture
from gcar_deploy.predict.center_predictor import SingleViewPredictor, open_predictor
from gcar_deploy.predict.encoding import encode
from gcar_deploy.predict.hull import visual_hull
from gcar_deploy.predict.kinds import read_predictor
from gcar_deploy.predict.single_view import DEPTH_SCALE_PIXELS, agreement, merge_views
from gcar_deploy.selftest import tiny_case

pytest.importorskip("gcar_export.scenes.render", reason="needs the export extra")
from tests.predict.test_hull import GRID, helix, scene

TINY = Path(__file__).parents[1] / "data" / "tiny-single.onnx"
SINGLE = RunOptions(predict=PredictOptions(predictor="single"))


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


def dice(confidence, truth):
    a, b = confidence >= 0.5, truth >= 0.5
    return 2 * (a & b).sum() / (a.sum() + b.sum())


@pytest.fixture(scope="module")
def hull():
    from gcar_export.scenes.render import occupancy

    views = scene(((-30, -20), (45, 25)))
    found = visual_hull(views, GRID, CandidateOptions())
    encoded = encode(found, [(c, p, True) for c, p in views])
    line = helix()
    truth, _, _ = occupancy(found.points_mm, 1.0, line[:-1], line[1:], np.full(len(line) - 1, 1.6))
    return views, found, encoded, truth


def test_true_depths_decide_and_wrong_ones_by_centimetres_still_help(hull):
    from gcar_deploy.predict.thinning import thin_hull

    views, found, encoded, truth = hull
    without = dice(thin_hull(found, encoded).confidence, truth)
    merged = merge_views(true_centers(views), found, encoded)
    assert merged.source == "single" and len(merged) == len(found)
    assert dice(merged.confidence, truth) > without + 0.3
    noisy = true_centers(views, 5.0, np.random.default_rng(0))
    rough = merge_views(noisy, found, encoded)
    assert dice(rough.confidence, truth) > without


def test_agreement_is_one_at_the_predicted_depth_and_a_quarter_at_the_scale(hull):
    views, _, _, _ = hull
    center = true_centers(views)[0]
    np.testing.assert_allclose(agreement(center, center.points_mm), 1.0, atol=1e-9)
    source = center.picture.carm.source_mm
    ray = (center.points_mm - source) / np.linalg.norm(center.points_mm - source, axis=1)[:, None]
    moved = center.points_mm + DEPTH_SCALE_PIXELS * center.picture.pixel_mm * ray
    np.testing.assert_allclose(agreement(center, moved), 0.25, atol=1e-9)


def test_a_view_that_says_nothing_changes_nothing(hull):
    views, found, _, _ = hull
    center = true_centers(views)[0]
    none = dataclasses.replace(
        center, points_mm=np.zeros((0, 3)), ray_mm=np.zeros(0), cell=np.zeros((0, 2), int)
    )
    np.testing.assert_array_equal(agreement(none, found.points_mm), 1.0)


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


def test_the_result_names_the_predictor(tmp_path):
    angiograms, grid, _ = tiny_case()
    result = Engine(TINY, options=SINGLE).reconstruct(angiograms, grid)
    assert result.predictor == "single" and result.model["name"] == "tiny-single"
    assert result.status == "degraded"
    assert any("one view at a time" in said for said in result.quality.findings)
    # The kind is read off the model where none is asked for.
    assert Engine(TINY).reconstruct(angiograms, grid).predictor == "single"


def test_a_model_of_the_other_kind_is_refused():
    multi = TINY.with_name("tiny.onnx")
    with pytest.raises(ModelError, match="is of kind multi, not single"):
        Engine(multi, options=SINGLE)
    with pytest.raises(ModelError, match="is of kind single, not multi"):
        Engine(TINY, options=RunOptions(predict=PredictOptions(predictor="multi")))


@pytest.mark.parametrize("wanted", ["auto", "multi", "single"])
def test_without_a_model_the_hull_is_thinned_and_the_result_says_so(wanted, monkeypatch, tmp_path):
    monkeypatch.setattr("gcar_deploy.models.spec.resources.files", lambda _: tmp_path)
    angiograms, grid, _ = tiny_case()
    options = RunOptions(predict=PredictOptions(predictor=wanted))
    result = Engine(options=options).reconstruct(angiograms, grid)
    assert result.predictor == "hull" and result.model is None
    assert result.status == "degraded" and "no model was used" in " ".join(result.quality.findings)
    name = "gcp-single" if wanted == "single" else "gcp-multi"
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
        return [np.full((1, 4, 8, 8), np.nan, np.float32)]


def test_values_that_are_not_finite_are_an_error():
    untested = dataclasses.replace(read_predictor(TINY), golden=None)
    with pytest.raises(NumericalError, match="not finite"):
        open_predictor(untested, session=_Broken()).predict(scene(((-30, -20), (45, 25))))
