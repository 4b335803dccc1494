"""Models: bytes and graphs, each with the hash that its spec then needs."""

from __future__ import annotations

import hashlib
import json
import random
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper

from gcar_deploy.config import ModelLimits
from gcar_deploy.errors import ModelError
from gcar_deploy.models.golden import Golden, read_golden
from gcar_deploy.predict.center_predictor import CenterPredictor
from gcar_deploy.predict.kinds import read_predictor
from tests.battery.damage import EDGES, damaged
from tests.battery.kinds.common import generator, outcome
from tests.battery.pool import Case, FoundError

TINY = Path(__file__).parents[3] / "tests" / "data" / "tiny.onnx"
_OPERATORS = ("Loop", "If", "Scan", "RandomNormal", "ScatterND", "ConstantOfShape", "Expand",
              "Range", "Tile", "Resize", "Pad", "Conv", "Einsum", "Identity")  # fmt: skip


def make(seed: int) -> Case:
    """Return the fuzz case of models."""
    original = TINY.read_bytes()
    spec = json.loads(TINY.with_suffix(".json").read_text())
    golden = read_golden(TINY, hashlib.sha256(original).hexdigest(), ModelLimits())
    if golden is None:
        raise ModelError("tiny.onnx has no golden case")

    def case(index: int, folder: Path) -> str:
        rng = generator("onnx", seed, index)
        data = _other_graph(original, rng) if rng.random() < 0.4 else original
        if data is original or rng.random() < 0.2:
            data = damaged(data, rng)
        path = folder / "m.onnx"
        _write(path, data, spec, golden, rng)
        return outcome(folder, (5, 8), lambda: _run(path, golden))

    return case


def _write(path: Path, data: bytes, spec: dict, golden: Golden, rng: random.Random) -> None:
    path.write_bytes(data)
    digest = hashlib.sha256(data).hexdigest()
    text = json.dumps({**spec, "sha256": digest})
    if rng.random() < 0.05:
        text = damaged(text.encode(), rng).decode("latin-1")
    path.with_suffix(".json").write_text(text)
    if rng.random() < 0.5:
        case = Golden(digest, golden.inputs, golden.outputs).to_bytes()
        case = damaged(case, rng) if rng.random() < 0.1 else case
        path.with_suffix(".golden.npz").write_bytes(case)


def _run(path: Path, golden: Golden) -> str:
    predictor = CenterPredictor(read_predictor(path), threads=1)
    answer = next(iter(predictor.session.answers(golden.inputs).values()))
    expected = golden.outputs["centers"]
    same = answer.shape == expected.shape and bool(np.allclose(answer, expected, 1e-3, 1e-4))
    if predictor.model.golden is not None and not same:
        raise FoundError("another answer than the golden one was accepted")
    return "loaded, same answer" if same else "loaded without golden case, other answer"


def _other_graph(original: bytes, rng: random.Random) -> bytes:
    model = onnx.ModelProto.FromString(original)
    graph = model.graph
    action = rng.randrange(9)
    tensor = rng.choice(graph.initializer)
    node = rng.choice(graph.node)
    if action == 0:
        node.op_type = rng.choice(_OPERATORS)
    elif action == 1:
        entry = tensor.external_data.add()
        entry.key, entry.value = "location", rng.choice(("../x", "/etc/hostname", "m.json"))
        tensor.data_location = rng.choice((TensorProto.EXTERNAL, TensorProto.DEFAULT))
    elif action == 2 and tensor.dims:
        tensor.dims[0] = rng.choice((-1, 0, 1, 2**31, 2**40, 2**62))
    elif action == 3 and tensor.data_type == TensorProto.FLOAT:
        values = np.frombuffer(tensor.raw_data, np.float32).copy()
        if values.size:
            values[rng.randrange(values.size)] = rng.choice((np.nan, np.inf, 1e30, -1e38, 1.5))
            tensor.raw_data = values.tobytes()
    elif action == 4:
        graph.node.remove(node)
    elif action == 5:
        swapped = rng.choice(graph.node)
        node.input[:], swapped.input[:] = list(swapped.input), list(node.input)
    elif action == 6:
        value = rng.choice([e for e in EDGES if isinstance(e, int) and abs(e) < 2**63])
        node.attribute.append(helper.make_attribute(rng.choice(("axis", "keepdims")), int(value)))
    elif action == 7:
        node.domain = rng.choice(("com.microsoft", "x", "ai.onnx.ml"))
    else:
        shape = helper.make_tensor("big", TensorProto.INT64, [2], [2 ** rng.randrange(41), 2**20])
        graph.initializer.append(shape)
        graph.node.insert(0, helper.make_node("ConstantOfShape", ["big"], ["bigger"]))
        node.input[0] = "bigger"
    return model.SerializeToString()
