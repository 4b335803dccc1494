"""Weights that a training of the segmenter begins with: of a checkpoint, or of an ONNX model."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import torch
from safetensors.torch import load_file

from gcar_deploy.errors import ModelError
from gcar_deploy.imaging.net import OUTPUTS, Segmenter
from gcar_deploy.models import Session
from gcar_deploy.types import Array
from gcar_export.training.checkpoint import WEIGHTS, weights
from gcar_export.training.networks.device_unet import DeviceUNet
from gcar_export.training.networks.mask_unet import MaskUNet


def begin_with(net: MaskUNet, path: Path) -> str:
    """Load what ``path`` holds into ``net`` and return the file's SHA-256.

    A model that says nothing of devices yet leaves that row of the head as it is.

    Raises
    ------
    ModelError
        A weight is missing or has another shape.
    """
    found = model_weights(path, WEIGHTS) if path.suffix == ".onnx" else weights(load_file(path))
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


class _Own:
    """Answers as ``models.Session`` does, with the segmenter's own word on devices."""

    def __init__(self, net: MaskUNet) -> None:
        self.net = net

    def run(
        self, inputs: Mapping[str, Array], *_: object, outputs: Sequence[str], **__: object
    ) -> list[Array]:
        with torch.no_grad():
            vessel, chord, device = self.net(torch.from_numpy(inputs["channels"])).split(1, dim=1)
        told = (torch.sigmoid(vessel), chord, torch.sigmoid(device))
        return [told[OUTPUTS.index(name)].numpy() for name in outputs]


def frozen_segmenter(path: Path) -> Segmenter:
    """Open the segmenter of a model or checkpoint as what a device network stands on.

    Raises
    ------
    ModelError
        As ``begin_with``.
    """
    net = MaskUNet()
    begin_with(net, path)
    return Segmenter(cast(Session, _Own(net.eval())))


def devices_of(net: DeviceUNet, model: Path) -> str:
    """Load the device network of an ONNX model into ``net`` and return the file's SHA-256.

    Raises
    ------
    ModelError
        The model holds none, or one of another size.
    """
    try:
        net.load_state_dict(model_weights(model, "devices."))
    except RuntimeError:
        raise ModelError(f"{model.name} holds no device network of this size") from None
    return hashlib.sha256(model.read_bytes()).hexdigest()


def model_weights(path: Path, prefix: str) -> dict[str, torch.Tensor]:
    """Read one network's weights out of an ONNX model: those whose names begin with ``prefix``.

    Convolutions keep their names; what scales and shifts after each follows in its order.
    """
    import onnx
    from onnx import numpy_helper

    graph = onnx.load(str(path)).graph
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
