"""The segmentation network keeps its golden case too."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pytest

from gcar_deploy.errors import ModelError
from gcar_deploy.imaging.net import INPUT, load_segmenter
from gcar_deploy.models.golden import golden_path

onnx = pytest.importorskip("onnx", reason="needs the export extra")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402


@pytest.fixture
def model(tmp_path, monkeypatch):
    """A network of one convolution, where the runtime looks for the shipped one."""
    weight = numpy_helper.from_array(np.full((1, INPUT["channels"], 1, 1), 0.5, np.float32), "w")
    nodes = [
        helper.make_node("Conv", ["channels", "w"], ["h"]),
        helper.make_node("Sigmoid", ["h"], ["p"]),
    ]
    shape = ["n", INPUT["channels"], "rows", "cols"]
    x = helper.make_tensor_value_info("channels", TensorProto.FLOAT, shape)
    y = helper.make_tensor_value_info("p", TensorProto.FLOAT, ["n", 1, "rows", "cols"])
    points = helper.make_tensor_value_info("points", TensorProto.FLOAT, ["k", INPUT["point"]])
    near = helper.make_tensor_value_info("near", TensorProto.INT64, ["k", INPUT["near"]])
    graph = helper.make_graph(nodes, "g", [x, points, near], [y], [weight])
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    path = tmp_path / "segmenter.onnx"
    monkeypatch.setattr("gcar_deploy.models.spec.shipped_model_path", lambda name: path)
    write(path, made)
    return path, made


def write(path, made):
    data = made.SerializeToString()
    path.write_bytes(data)
    spec = {"schema": "gcar-model/1", "name": "segmenter", "kind": "segmenter", "inputs": INPUT,
            "sha256": hashlib.sha256(data).hexdigest()}  # fmt: skip
    path.with_suffix(".json").write_text(json.dumps(spec))


def test_the_case_is_made_and_checked_at_load(model):
    golden = pytest.importorskip("gcar_export.shipping.golden", reason="needs the export extra")
    path, made = model
    assert golden.write_golden(path).exists()
    assert load_segmenter("net") is not None
    made.graph.initializer[0].CopyFrom(
        numpy_helper.from_array(np.full((1, INPUT["channels"], 1, 1), 0.6, np.float32), "w")
    )
    write(path, made)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    with np.load(golden_path(path)) as found:
        arrays = dict(found)
    arrays["model_sha256"] = np.array(digest)
    np.savez(golden_path(path), **arrays)
    with pytest.raises(ModelError, match="golden case"):
        load_segmenter("net")
