"""The true ONNX path with a tiny model, and every way a model file can be wrong."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from gcar_deploy.config import CandidateOptions
from gcar_deploy.errors import ModelError, NumericalError
from gcar_deploy.predict.center_predictor import CenterPredictor
from gcar_deploy.predict.decision import decide
from gcar_deploy.predict.encoding import encode
from gcar_deploy.predict.hull import visual_hull
from gcar_deploy.predict.kinds import read_predictor

pytest.importorskip("gcar_export.scenes.render", reason="needs the export extra")
from tests.predict.test_hull import GRID, scene

TINY = Path(__file__).parents[1] / "data" / "tiny.onnx"


def inputs(angles=((-30, -20), (45, 25))):
    views = scene(angles)
    hull = visual_hull(views, GRID, CandidateOptions())
    return hull, encode(hull, [(c, p, True) for c, p in views])


def test_one_answer_per_candidate():
    hull, encoded = inputs()
    centers = CenterPredictor(read_predictor(TINY)).predict(hull, encoded)
    assert len(centers) == len(hull)
    assert ((centers.confidence >= 0) & (centers.confidence <= 1)).all()
    assert (centers.radius_mm > 0).all()
    assert centers.offset_mm.shape == (len(hull), 3)


@pytest.mark.req("REQ-34")
def test_any_number_of_views_in_any_order():
    predictor = CenterPredictor(read_predictor(TINY))
    angles = ((-30, -20), (45, 25), (0, 30), (80, 0))
    for n in (2, 3, 4):
        a = predictor.predict(*inputs(angles[:n]))
        b = predictor.predict(*inputs(angles[:n][::-1]))
        np.testing.assert_allclose(a.confidence, b.confidence, atol=1e-5)


@pytest.mark.parametrize("threads", [1, 2, 4])
@pytest.mark.req("REQ-33")
def test_same_input_same_bytes(threads):
    """Sums by scatter would race between threads and fail this."""
    hull, encoded = inputs()
    predictor = CenterPredictor(read_predictor(TINY), threads=threads)
    first = predictor.predict(hull, encoded).confidence.tobytes()
    for _ in range(10):
        assert predictor.predict(hull, encoded).confidence.tobytes() == first


@pytest.fixture
def copy(tmp_path):
    for suffix in (".onnx", ".json"):
        shutil.copy(TINY.with_suffix(suffix), tmp_path / f"m{suffix}")
    return tmp_path / "m.onnx"


@pytest.mark.req("REQ-16")
def test_altered_model_is_refused(copy):
    data = bytearray(copy.read_bytes())
    data[len(data) // 2] ^= 1
    copy.write_bytes(bytes(data))
    with pytest.raises(ModelError, match="was altered"):
        read_predictor(copy)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p.unlink(), "m.onnx: no such file"),
        (lambda p: p.with_suffix(".json").unlink(), "m.json: no such file"),
        (lambda p: p.with_suffix(".json").write_text("{"), "is not JSON"),
        (lambda p: p.with_suffix(".json").write_text("[]"), "is not of schema"),
        (lambda p: edit(p, "schema", "gcar-model/9"), "is not of schema"),
        (
            lambda p: edit(p, "inputs", {"view_features": 3, "levels": 3}),
            "wants inputs.view_features",
        ),
        (lambda p: edit(p, "inputs", None), "wants inputs"),
    ],
)
@pytest.mark.req("REQ-16")
def test_wrong_files_say_what_is_wrong(copy, change, message):
    change(copy)
    with pytest.raises(ModelError, match=message):
        read_predictor(copy)


def edit(path, key, value):
    spec = json.loads(path.with_suffix(".json").read_text())
    spec[key] = value
    path.with_suffix(".json").write_text(json.dumps(spec))


def test_a_model_that_is_no_model(copy):
    import hashlib

    copy.write_bytes(b"not a graph")
    edit(copy, "sha256", hashlib.sha256(b"not a graph").hexdigest())
    with pytest.raises(ModelError, match="no ONNX model"):
        CenterPredictor(read_predictor(copy))


class _Broken:
    """A session whose weights went wrong."""

    def run(self, _names, feed, _options):
        return [np.full((feed["ray"].shape[1], 5), np.nan, np.float32)]


@pytest.mark.req("REQ-20")
def test_values_that_are_not_finite_are_an_error():
    untested = dataclasses.replace(read_predictor(TINY), golden=None)
    with pytest.raises(NumericalError, match="not finite"):
        CenterPredictor(untested, session=_Broken()).predict(*inputs())


@pytest.mark.parametrize("calibrated", [True, False])
def test_decision_explains_rays_and_prefers_the_likelier(calibrated):
    from dataclasses import replace

    from gcar_export.scenes.render import occupancy
    from tests.predict.test_hull import helix

    hull, encoded = inputs()
    p = helix()
    truth, _, _ = occupancy(hull.points_mm, 1.0, p[:-1], p[1:], np.full(len(p) - 1, 1.6))
    rng = np.random.default_rng(0)
    hedged = np.clip(0.06 + 0.45 * truth + 0.12 * rng.normal(size=len(truth)), 0.02, 0.98)
    centers = CenterPredictor(read_predictor(TINY)).predict(hull, encoded)
    decided = decide(replace(centers, confidence=hedged), encoded, 0.0 if calibrated else 0.25)

    def dice(x):
        a, b = x >= 0.5, truth >= 0.5
        return 2 * (a & b).sum() / (a.sum() + b.sum())

    assert dice(decided.confidence) > dice(hedged)
    assert dice(decided.confidence) > 0.8
