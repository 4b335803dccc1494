"""From a checkpoint to one ONNX file with its spec, whichever network the checkpoint holds."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from gcar_deploy.errors import ModelError
from gcar_deploy.predict.center_map import (
    DEPTH_PIXELS,
    MAX_PATH_PIXELS,
    OFFSET_PIXELS,
)
from gcar_deploy.predict.encoding import (
    LEVELS,
    VIEW_FEATURES,
    flat_inputs,
    input_names,
)
from gcar_export.scenes.gantry import PAPER_VIEWS, USUAL_SPREAD_DEG, USUAL_VIEWS
from gcar_export.shipping.quiet import quiet_tracing
from gcar_export.shipping.row_blocks import in_blocks
from gcar_export.training.checkpoint import network_of, read_manifest
from gcar_export.training.dataset import PATH_CELLS, training_scene
from gcar_export.training.examinations import FINE_CELLS_MM, PAPER_CELLS_MM
from gcar_export.training.networks.sparse import SparseConfig, SparsePredictor
from gcar_export.training.networks.unet import UNetConfig, UNetPredictor
from gcar_export.training.warm_start import license_of

OPSET = 18
IR_VERSION = 10
#: a shipped model may weigh so much
MAX_BYTES = 16 * 2**20
_TRACE_SEED = 70_000


class DeployedSparse(torch.nn.Module):
    """The multi-view predictor with flat inputs and one output: confidence, offset, radius."""

    def __init__(self, net: SparsePredictor) -> None:
        super().__init__()
        self.net = net

    def forward(
        self, features: torch.Tensor, ray: torch.Tensor, ray_path: torch.Tensor,
        weight: torch.Tensor, *tables: torch.Tensor,
    ) -> torch.Tensor:  # fmt: skip
        """Arrays as ``flat_inputs`` orders them, to (n, 5)."""
        neighbours, parent = tables[: LEVELS + 1], tables[LEVELS + 1 : 2 * LEVELS + 1]
        members, children = tables[2 * LEVELS + 1], tables[2 * LEVELS + 2 :]
        out = self.net(features, ray, ray_path, weight, neighbours, parent, members, children)[-1]
        return torch.cat([torch.sigmoid(out[:, :1]), out[:, 1:]], dim=1)


def load_checkpoint(path: Path) -> SparsePredictor | UNetPredictor:
    """Read ``checkpoint.safetensors`` beside its ``manifest.json``; no pickle anywhere.

    Raises
    ------
    ModelError
        Either is damaged, or they do not belong together.
    """
    networks: dict[str, Callable[..., SparsePredictor | UNetPredictor]] = {
        "sparse": lambda width, **more: SparsePredictor(SparseConfig(width=width, **more)),
        "unet": lambda width, **more: UNetPredictor(UNetConfig(width=width, **more)),
    }
    return network_of(path, networks)


def deployed(checkpoint: Path) -> DeployedSparse | UNetPredictor:
    """Return the network with the inputs and outputs of its ONNX graph."""
    net = load_checkpoint(checkpoint)
    return (DeployedSparse(net) if isinstance(net, SparsePredictor) else net).eval()


def graph_inputs(net: DeployedSparse | UNetPredictor) -> list[str]:
    """Names of the graph's inputs."""
    if isinstance(net, DeployedSparse):
        return input_names()
    return ["picture", "axes"] if net.config.pose else ["picture"]


def export_model(checkpoint: Path, out: Path) -> dict[str, Any]:
    """Write ``out`` (.onnx) and its spec (.json); returns the spec.

    Raises
    ------
    ModelError
        The checkpoint has no manifest, or the graph would not be deterministic.
    """
    net = deployed(checkpoint)
    out.parent.mkdir(parents=True, exist_ok=True)
    with quiet_tracing():
        program = _trace_sparse(net) if isinstance(net, DeployedSparse) else _trace_unet(net)
    program.save(str(out), external_data=False)
    spec = _spec(net, _training(checkpoint), out.stem)
    return finish(out, spec)


def _training(checkpoint: Path) -> dict[str, Any]:
    """Return the manifest as it was at the step of this checkpoint."""
    manifest = read_manifest(checkpoint)
    best = manifest.pop("best", None)
    if checkpoint.name == "best.safetensors" and best is not None:
        manifest |= {"step": best["step"], "validation": best["validation"]}
    return manifest


def _trace_sparse(net: DeployedSparse) -> Any:
    tensors = tuple(
        torch.from_numpy(a) for a in flat_inputs(training_scene(_TRACE_SEED, 0).encoded)
    )
    auto = torch.export.Dim.AUTO
    table_shapes = (
        *({0: auto} for _ in range(2 * LEVELS + 1)),
        {0: auto, 1: auto, 2: auto},
        *({0: auto} for _ in range(LEVELS)),
    )
    shapes = (*({0: auto, 1: auto} for _ in range(4)), table_shapes)
    return torch.onnx.export(
        net, tensors, dynamo=True, opset_version=OPSET, external_data=False, verbose=False,
        input_names=input_names(), output_names=["centers"], dynamic_shapes=shapes,
    )  # fmt: skip


def _trace_unet(net: UNetPredictor) -> Any:
    n = net.config.pixels
    # Two pictures, or the size of the batch would be taken for a constant.
    example = (torch.rand(2, 1, n, n), torch.eye(3).repeat(2, 1, 1))[: len(graph_inputs(net))]
    return torch.onnx.export(
        net, example, dynamo=True, opset_version=OPSET, external_data=False, verbose=False,
        input_names=graph_inputs(net), output_names=["centers"],
        dynamic_shapes=tuple({0: torch.export.Dim("batch")} for _ in example),
    )  # fmt: skip


def _spec(
    net: DeployedSparse | UNetPredictor, manifest: dict[str, Any], name: str
) -> dict[str, Any]:
    spec: dict[str, Any] = {
        "schema": "gcar-model/1",
        "name": name,
        "opset": OPSET,
        "ir_version": IR_VERSION,
        "precision": "float32",
        "training": manifest,
        "license": license_of(manifest),
        "parameters": sum(p.numel() for p in net.parameters()),
    }
    if isinstance(net, DeployedSparse):
        return spec | {
            "kind": "multi",
            "inputs": {"view_features": VIEW_FEATURES, "levels": LEVELS, "net_pixels": 128},
            "outputs": ["confidence", "offset_cells x y z", "radius_cells"],
            "spacing_mm": [FINE_CELLS_MM[0], PAPER_CELLS_MM[1]],
            "path_cells": list(PATH_CELLS),
            "geometry": "2 views or more, 25 .. 155 deg apart",
        }
    config = net.config
    usual = manifest["options"]["usual"]
    names = ", ".join(_view_name(a, b) for a, b in USUAL_VIEWS)
    return spec | {
        "kind": "paper",
        "inputs": {
            "pixels": config.pixels,
            "alpha": config.alpha,
            "pose": config.pose,
            "directions_deg": [] if usual else [list(view) for view in PAPER_VIEWS],
            "depth_pixels": DEPTH_PIXELS,
            "offset_pixels": OFFSET_PIXELS,
            "max_path_pixels": MAX_PATH_PIXELS,
        },
        "outputs": ["depth 0 .. 1 along the true ray", "offset_pixels u v w"],
        "spacing_mm": [0.8, 1.6],
        "geometry": f"{names}, give or take {USUAL_SPREAD_DEG:g} deg, SOD 700 .. 820 mm"
        if usual
        else "the paper's two views, a cube of 180 mm seen from 1406 mm",
    }


def _view_name(primary: float, secondary: float) -> str:
    """Name a direction as it is said in the room."""
    first = "AP" if not primary else f"{'LAO' if primary > 0 else 'RAO'} {abs(primary)}"
    return f"{first} {'CRA' if secondary > 0 else 'CAU'} {abs(secondary)}"


def finish(out: Path, spec: dict[str, Any]) -> dict[str, Any]:
    """Clean and block the graph at ``out``, put its card into it, check it and write its spec.

    Raises
    ------
    ModelError
        The graph sums by scatter, which races, or weighs more than ``MAX_BYTES``.
    """
    import onnx

    model = onnx.load(str(out), load_external_data=False)
    model.ir_version = IR_VERSION
    _refuse_scatters(model)
    in_blocks(model)
    for node in model.graph.node:
        # Where each node came from in the source is of no use to a host, and outweighs a graph.
        del node.metadata_props[:]
        node.doc_string = ""
    used = {node.domain for node in model.graph.node}
    for entry in [e for e in model.opset_import if e.domain not in used]:
        model.opset_import.remove(entry)
    del model.metadata_props[:]
    for key in ("schema", "name", "kind", "license"):
        entry = model.metadata_props.add()
        entry.key, entry.value = f"gcar.{key}", str(spec[key])
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(out))
    data = out.read_bytes()
    if len(data) > MAX_BYTES:
        raise ModelError(f"{out.name} weighs {len(data)} bytes; at most {MAX_BYTES} are allowed")
    spec = {**spec, "sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
    out.with_suffix(".json").write_text(json.dumps(spec, indent=1) + "\n", encoding="utf-8")
    return spec


def _refuse_scatters(model: Any) -> None:
    """Refuse a graph that sums by scatter: ONNX Runtime races on repeated indices."""
    found: Sequence[str] = sorted(
        {n.op_type for n in model.graph.node if n.op_type.startswith("Scatter")}
    )
    if found:
        raise ModelError(f"the graph holds {', '.join(found)}, which is not deterministic")
