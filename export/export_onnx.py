"""From a checkpoint to one ONNX file with its spec, and the proof that both say the same."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np
import torch

from gcar_deploy.errors import ModelError
from gcar_deploy.predict.encoding import LEVELS, VIEW_FEATURES, flat_inputs, input_names
from gcar_export.checkpoint import filled, read_manifest, read_tensors
from gcar_export.networks.sparse import SparseConfig, SparsePredictor

OPSET = 18
IR_VERSION = 10
#: largest difference between torch and ONNX Runtime, as a share of the output's range
PARITY = 1e-4


class _Deployed(torch.nn.Module):
    """The predictor with flat inputs and one output: confidence, offset, radius."""

    def __init__(self, net: SparsePredictor) -> None:
        super().__init__()
        self.net = net

    def forward(self, features, ray, ray_path, weight, *tables):
        neighbours, parent = tables[: LEVELS + 1], tables[LEVELS + 1 : 2 * LEVELS + 1]
        members, children = tables[2 * LEVELS + 1], tables[2 * LEVELS + 2 :]
        out = self.net(features, ray, ray_path, weight, neighbours, parent, members, children)[-1]
        return torch.cat([torch.sigmoid(out[:, :1]), out[:, 1:]], dim=1)


def load_checkpoint(path: Path) -> SparsePredictor:
    """Read ``checkpoint.safetensors`` beside its ``manifest.json``; no pickle anywhere.

    Raises
    ------
    ModelError
        Either is damaged, or they do not belong together.
    """
    config = dict(read_manifest(path)["config"])
    try:
        config["width"] = tuple(config["width"])
        net = SparsePredictor(SparseConfig(**config))
    except (KeyError, TypeError, ValueError, RuntimeError, IndexError, ZeroDivisionError) as error:
        raise ModelError(f"manifest.json of {path.name}: no such network ({error})") from None
    filled(net, read_tensors(path), path.name)
    return net.eval()


def export_sparse(checkpoint: Path, out: Path, example) -> dict:
    """Write ``out`` (.onnx) and its spec (.json); returns the spec.

    Parameters
    ----------
    checkpoint : path of ``checkpoint.safetensors``
    out : path of the ONNX file to write
    example : Encoded
        A real scene, to trace with.
    """
    import onnx

    net = _Deployed(load_checkpoint(checkpoint)).eval()
    tensors = tuple(torch.from_numpy(a) for a in flat_inputs(example))
    auto = torch.export.Dim.AUTO
    table_shapes = (
        *({0: auto} for _ in range(2 * LEVELS + 1)),
        {0: auto, 1: auto, 2: auto},
        *({0: auto} for _ in range(LEVELS)),
    )
    shapes = (
        {0: auto, 1: auto},
        {0: auto, 1: auto},
        {0: auto, 1: auto},
        {0: auto, 1: auto},
        table_shapes,
    )
    program = torch.onnx.export(
        net,
        tensors,
        dynamo=True,
        opset_version=OPSET,
        external_data=False,
        input_names=input_names(),
        output_names=["centers"],
        dynamic_shapes=shapes,
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    program.save(str(out), external_data=False)
    model = onnx.load(str(out))
    model.ir_version = IR_VERSION
    _refuse_scatters(model)
    for node in model.graph.node:
        # Where each node came from in the source is of no use to a host, and outweighs a graph.
        del node.metadata_props[:]
        node.doc_string = ""
    manifest = json.loads((checkpoint.parent / "manifest.json").read_text())
    spec = {
        "schema": "gcar-model/1",
        "name": out.stem,
        "kind": "multi",
        "inputs": {"view_features": VIEW_FEATURES, "levels": LEVELS, "net_pixels": 128},
        "outputs": ["confidence", "offset_cells x y z", "radius_cells"],
        "spacing_mm": [0.85, 1.5],
        "opset": OPSET,
        "ir_version": IR_VERSION,
        "training": manifest,
        "license": "Apache-2.0; trained on generated trees alone",
    }
    del model.metadata_props[:]
    for key in ("schema", "name", "kind", "license"):
        entry = model.metadata_props.add()
        entry.key, entry.value = f"gcar.{key}", str(spec[key])
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(out))
    data = out.read_bytes()
    spec["sha256"], spec["bytes"] = hashlib.sha256(data).hexdigest(), len(data)
    spec["parameters"] = sum(p.numel() for p in net.parameters())
    out.with_suffix(".json").write_text(json.dumps(spec, indent=1) + "\n")
    return spec


def _refuse_scatters(model) -> None:
    """Refuse a graph that sums by scatter: ONNX Runtime races on repeated indices."""
    found = sorted({n.op_type for n in model.graph.node if n.op_type.startswith("Scatter")})
    if found:
        raise ValueError(f"the graph holds {', '.join(found)}, which is not deterministic")


@dataclasses.dataclass(frozen=True)
class Parity:
    """Largest difference between torch and ONNX Runtime over some inputs."""

    inputs: int
    worst: float
    decisions_equal: float


def parity(checkpoint: Path, model: Path, scenes) -> Parity:
    """Compare both on the arrays of ``scenes`` (an iterable of Encoded)."""
    import onnxruntime as ort

    net = _Deployed(load_checkpoint(checkpoint)).eval()
    session = ort.InferenceSession(str(model), providers=["CPUExecutionProvider"])
    worst, equal, count, total = 0.0, 0, 0, 0
    for encoded in scenes:
        arrays = flat_inputs(encoded)
        with torch.no_grad():
            a = net(*[torch.from_numpy(x) for x in arrays]).numpy()
        b = session.run(None, dict(zip(input_names(), arrays, strict=True)))[0]
        worst = max(worst, float(np.abs(a - b).max() / max(float(np.ptp(a)), 1.0)))
        equal += int(((a[:, 0] >= 0.5) == (b[:, 0] >= 0.5)).sum())
        total += len(a)
        count += 1
    return Parity(count, worst, equal / max(total, 1))


#: seed of the scenes that parity is checked on
PARITY_SEED = 70_001


def export_checked(checkpoint: Path, out: Path, scenes: int) -> Parity:
    """Export, compare on generated scenes and refuse what differs.

    Raises
    ------
    ModelError
        The ONNX file says something else than the checkpoint; the file is taken away.
    """
    from gcar_export.dataset import training_scene
    from gcar_export.golden import write_golden

    export_sparse(checkpoint, out, training_scene(PARITY_SEED, 0).encoded)
    found = parity(checkpoint, out, (training_scene(PARITY_SEED, i).encoded for i in range(scenes)))
    if found.worst > PARITY or found.decisions_equal < 0.9999:
        for path in (out, out.with_suffix(".json")):
            path.unlink(missing_ok=True)
        raise ModelError(
            f"{out.name} differs from its checkpoint by {found.worst:.1e} of the range "
            f"(at most {PARITY:g}); {found.decisions_equal:.4%} of decisions equal"
        )
    write_golden(out, force=True)
    return found
