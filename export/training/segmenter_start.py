"""Weights that a training of the segmenter begins with: of a checkpoint, or of an ONNX model."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gcar_deploy.errors import ModelError
from gcar_export.training.checkpoint import WEIGHTS, best_weights, read_tensors
from gcar_export.training.networks.line_net import LineNet
from gcar_export.training.networks.mask_unet import MaskUNet


def begin_with(net: MaskUNet, path: Path) -> str:
    """Load what ``path`` holds into ``net`` and return the file's SHA-256.

    A model that says nothing of devices yet leaves that row of the head as it is.

    Raises
    ------
    ModelError
        The file is damaged; a weight is missing or has another shape.
    """
    found = (
        model_weights(path, WEIGHTS) if path.suffix == ".onnx" else best_weights(read_tensors(path))
    )
    own = net.state_dict()
    for name, value in own.items():
        given = found.get(name)
        rows = 0 if given is None else given.shape[0]
        if given is None or given.shape[1:] != value.shape[1:] or rows > value.shape[0]:
            raise ModelError(f"{path.name} does not hold {name} of shape {tuple(value.shape)}")
        if rows < value.shape[0] and not name.startswith("head."):
            raise ModelError(f"{path.name}: {name} has {rows} channels, not {value.shape[0]}")
        value[:rows] = given
    net.load_state_dict(own)
    return hashlib.sha256(path.read_bytes()).hexdigest()


def devices_of(net: LineNet, model: Path) -> str:
    """Load the network of lines of an ONNX model into ``net`` and return the file's SHA-256.

    Raises
    ------
    ModelError
        The file is no ONNX model, or holds none or one of another size.
    """
    from onnx import numpy_helper

    prefix = "devices."
    found = {
        one.name.removeprefix(prefix): torch.from_numpy(numpy_helper.to_array(one).copy())
        for one in _graph(model).initializer
        if one.name.startswith(prefix)
    }
    try:
        net.load_state_dict(found)
    except RuntimeError:
        raise ModelError(f"{model.name} holds no network of lines of this size") from None
    return hashlib.sha256(model.read_bytes()).hexdigest()


def _graph(model: Path) -> Any:
    import onnx
    from google.protobuf.message import DecodeError

    try:
        return onnx.load(str(model)).graph
    except DecodeError:
        raise ModelError(f"{model} is no ONNX model") from None


def vessels_sha256(model: Path) -> str:
    """SHA-256 of the weights that find vessels: the network of lines in the file is left out."""
    digest = hashlib.sha256()
    for name, value in sorted(model_weights(model, WEIGHTS).items()):
        digest.update(name.encode() + value.numpy().tobytes())
    return digest.hexdigest()


def model_weights(path: Path, prefix: str) -> dict[str, torch.Tensor]:
    """Read one network's weights out of an ONNX model: those whose names begin with ``prefix``.

    Convolutions keep their names; what scales and shifts after each follows in its order.

    Raises
    ------
    ModelError
        The file is no ONNX model.
    """
    from onnx import numpy_helper

    graph = _graph(path)
    arrays = {one.name: numpy_helper.to_array(one) for one in graph.initializer}
    found = {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
    layer = ""
    for node in graph.node:
        held = [name for name in node.input if name in arrays]
        if node.op_type == "Conv":
            layer = ""
            # A head is scaled by nothing; ``layer`` is the norm behind the convolution.
            if held[0].startswith(prefix) and "." in held[0].removeprefix(prefix)[:-7]:
                block, number = held[0].removesuffix(".weight").removeprefix(prefix).rsplit(".", 1)
                layer = f"{block}.{int(number) + 1}"
        for name in held:
            if layer and node.op_type in ("Mul", "Add") and arrays[name].ndim == 4:
                part = "weight" if node.op_type == "Mul" else "bias"
                found[f"{layer}.{part}"] = arrays[name].reshape(-1)
    return {k: torch.from_numpy(np.array(v, np.float32)) for k, v in found.items()}
