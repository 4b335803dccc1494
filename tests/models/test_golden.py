"""A model must still say what it said when it was made."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import pickle
import shutil
from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest

from gcar_deploy.config import ModelLimits
from gcar_deploy.errors import ModelError, UsageError
from gcar_deploy.imaging.net import KIND as SEGMENTER
from gcar_deploy.models.golden import check_golden, golden_path, read_golden
from gcar_deploy.models.session import Session
from gcar_deploy.models.spec import read_model
from gcar_deploy.predict.center_predictor import CenterPredictor
from gcar_deploy.predict.kinds import MULTI, PREDICTOR_KINDS, read_predictor

KINDS = (*PREDICTOR_KINDS.values(), SEGMENTER)
TINY = Path(__file__).parents[1] / "data" / "tiny.onnx"


@pytest.fixture
def copy(tmp_path) -> Path:
    for suffix in (".onnx", ".json", ".golden.npz"):
        shutil.copy(TINY.with_suffix(suffix), tmp_path / f"m{suffix}")
    return tmp_path / "m.onnx"


def replaced(path: Path, data: bytes) -> None:
    """Put another graph there, with the hash and golden hash that it would need."""
    path.write_bytes(data)
    digest = hashlib.sha256(data).hexdigest()
    spec = json.loads(path.with_suffix(".json").read_text())
    spec["sha256"] = digest
    path.with_suffix(".json").write_text(json.dumps(spec))
    with np.load(golden_path(path)) as found:
        arrays = dict(found)
    arrays["model_sha256"] = np.array(digest)
    np.savez(golden_path(path), **arrays)


@pytest.mark.req("REQ-18")
def test_every_shipped_model_has_one_and_keeps_it():
    shipped = MULTI.path
    assert shipped is not None
    for model in sorted(shipped.parent.glob("*.onnx")):
        found = read_model(model, KINDS)
        assert found.golden is not None, f"{model.name}: gcar-export golden {model.name}"
        session = ort.InferenceSession(found.data, providers=["CPUExecutionProvider"])
        assert check_golden(found.name, found.golden, session.run) < 1e-4


def test_a_shipped_model_is_checked_by_its_hash_alone(tmp_path, monkeypatch):
    """Neither the guard nor the golden case sees it; a copy elsewhere is a stranger's."""
    shipped, none = SEGMENTER.path, ModelLimits(max_nodes=1)
    assert shipped is not None
    with monkeypatch.context() as patch:
        patch.setattr("gcar_deploy.models.guard.check_onnx", lambda *_: pytest.fail("walked"))
        found = read_model(shipped, KINDS)
    assert found.pinned
    assert found.golden is not None
    wrong = {name: array + 1 for name, array in found.golden.outputs.items()}
    golden = dataclasses.replace(found.golden, outputs=wrong)
    inputs = list(golden.inputs)
    session = Session(dataclasses.replace(found, golden=golden), inputs, threads=1)
    with pytest.raises(ModelError, match="golden case"):
        session.check_golden()
    with pytest.raises(ModelError, match="golden case"):
        Session(dataclasses.replace(found, golden=golden, pinned=False), inputs, threads=1)
    for suffix in (".onnx", ".json", ".golden.npz"):
        shutil.copy(shipped.with_suffix(suffix), tmp_path / f"segmenter{suffix}")
    assert not read_model(tmp_path / shipped.name, KINDS).pinned
    with pytest.raises(ModelError, match="more than 1 nodes"):
        read_model(tmp_path / shipped.name, KINDS, none)


def test_shipped_files_are_those_of_the_manifest():
    shipped = MULTI.path
    assert shipped is not None
    lines = (shipped.parent / "SHA256SUMS").read_text().splitlines()
    listed = {name: digest for digest, name in (line.split() for line in lines)}
    files = {p.name for p in shipped.parent.iterdir() if p.suffix in (".onnx", ".json", ".npz")}
    assert set(listed) == files
    for name, digest in listed.items():
        assert hashlib.sha256((shipped.parent / name).read_bytes()).hexdigest() == digest, name


@pytest.mark.req("REQ-18")
def test_a_slightly_other_weight_is_noticed(tmp_path):
    shipped = MULTI.path
    assert shipped is not None
    copy = tmp_path / "m.onnx"
    for suffix in (".onnx", ".json", ".golden.npz"):
        shutil.copy(shipped.with_suffix(suffix), copy.with_suffix(suffix))
    onnx = pytest.importorskip("onnx", reason="needs the export extra")
    graph = onnx.load(str(copy), load_external_data=False)
    weight = max(
        (t for t in graph.graph.initializer if t.data_type == 1), key=lambda t: len(t.raw_data)
    )
    values = np.frombuffer(weight.raw_data, np.float32).copy()
    weight.raw_data = (values * 1.05).tobytes()
    replaced(copy, graph.SerializeToString())
    with pytest.raises(ModelError, match="golden case"):
        CenterPredictor(read_predictor(copy), threads=1)


def test_another_models_case_is_refused(copy):
    with np.load(golden_path(copy)) as found:
        arrays = dict(found)
    arrays["model_sha256"] = np.array("0" * 64)
    np.savez(golden_path(copy), **arrays)
    with pytest.raises(ModelError, match="another model"):
        read_predictor(copy)


class _Canary:
    def __reduce__(self):
        return (pytest.fail, ("a pickle was run",))


def pickled() -> bytes:
    stream = io.BytesIO()
    np.savez(stream, model_sha256=np.array([_Canary()], dtype=object))
    return stream.getvalue()


@pytest.mark.parametrize(
    "data",
    [b"", b"PK", bytes(100), pickled(), pickle.dumps({"a": 1}), b"PK\x03\x04" + bytes(60)],
    ids=["empty", "two bytes", "zeros", "pickle in it", "pickle", "broken zip"],
)
def test_damaged_cases_are_refused_and_nothing_is_run(copy, data):
    golden_path(copy).write_bytes(data)
    with pytest.raises(ModelError, match="damaged"):
        read_predictor(copy)


def test_a_case_that_unpacks_to_much_is_refused(copy):
    np.savez_compressed(golden_path(copy), a=np.zeros(2**20))
    with pytest.raises(ModelError, match="damaged"):
        read_golden(copy, "", ModelLimits(max_golden_bytes=2**14))


def test_a_model_without_one_still_loads(copy):
    golden_path(copy).unlink()
    predictor = CenterPredictor(read_predictor(copy), threads=1)
    assert predictor.session.check_golden() is None


def test_made_again_it_loads_and_is_never_overwritten_unasked(copy):
    golden = pytest.importorskip("gcar_export.shipping.golden", reason="needs the export extra")
    before = golden_path(copy).read_bytes()
    with pytest.raises(UsageError, match="--force"):
        golden.write_golden(copy)
    assert golden_path(copy).read_bytes() == before
    golden.write_golden(copy, force=True)
    assert CenterPredictor(read_predictor(copy), threads=1).session.check_golden() == 0.0
    with np.load(io.BytesIO(before)) as a, np.load(golden_path(copy)) as b:
        assert sorted(a.files) == sorted(b.files)
    assert [p.name for p in copy.parent.glob("*.old")] == []
