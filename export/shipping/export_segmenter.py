"""From checkpoints of the segmentation network to one ONNX file with its spec, and the proof.

One file holds two networks: the segmenter, and the one that tells devices along its lines.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import click
import numpy as np
import torch

from gcar_deploy.errors import ModelError, UsageError
from gcar_deploy.imaging.line_strips import NEAR, POINT, line_points
from gcar_deploy.imaging.net import (
    INPUT,
    INPUTS,
    KIND,
    OUTPUTS,
    STRIDE,
    Segmenter,
    open_segmenter,
)
from gcar_deploy.imaging.skeleton import skeletonize
from gcar_deploy.models import Session, golden_path
from gcar_deploy.types import Array
from gcar_export.scenes.angiograms import training_pair
from gcar_export.shipping.export_onnx import IR_VERSION, OPSET
from gcar_export.shipping.golden import write_golden
from gcar_export.shipping.parity import PARITY
from gcar_export.shipping.quiet import quiet_tracing
from gcar_export.training.checkpoint import network_of
from gcar_export.training.networks.line_net import LineNet, LineNetConfig, no_vessel
from gcar_export.training.networks.mask_unet import MaskUNet, MaskUNetConfig
from gcar_export.training.segmenter_start import begin_with, devices_of, vessels_sha256
from gcar_export.training.terms import license_of, trained_as

#: seed of the pictures that parity is checked on
PARITY_SEED = 70_002


class _GroupNorm(torch.nn.Module):
    """Group norm whose means are taken axis by axis.

    ONNX Runtime adds a whole group up in one row of single precision, which loses four digits.
    """

    def __init__(self, norm: torch.nn.GroupNorm) -> None:
        super().__init__()
        self.norm = norm

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return what the norm that was given returns."""
        away = x - self._mean(x)
        scaled = away / torch.sqrt(self._mean(away * away) + self.norm.eps)
        scale, shift = (p[None, :, None, None] for p in (self.norm.weight, self.norm.bias))
        return scaled * scale + shift

    def _mean(self, x: torch.Tensor) -> torch.Tensor:
        groups = self.norm.num_groups
        of_channel = x.mean(3, keepdim=True).mean(2, keepdim=True)
        mean = of_channel.reshape(1, groups, -1).mean(2, keepdim=True)
        return mean.expand(1, groups, x.shape[1] // groups).reshape(1, x.shape[1], 1, 1)


class _Deployed(torch.nn.Module):
    """Both networks as one: probability and chords of a picture, devices of its lines."""

    def __init__(self, net: MaskUNet, devices: LineNet) -> None:
        super().__init__()
        self.net, self.devices = net, devices
        for part in list(net.modules()):
            for name, norm in list(part.named_children()):
                if isinstance(norm, torch.nn.GroupNorm):
                    setattr(part, name, _GroupNorm(norm))

    def forward(
        self, channels: torch.Tensor, points: torch.Tensor, near: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        logit, chord, _ = self.net(channels).split(1, dim=1)
        return torch.sigmoid(logit), chord, no_vessel(self.devices(points, near))


def load_segmenter_checkpoint(path: Path) -> MaskUNet:
    """Read ``checkpoint.safetensors`` beside its ``manifest.json``, or an ONNX segmenter.

    Raises
    ------
    ModelError
        Damaged, or of another network.
    """
    if path.suffix == ".onnx":
        net = MaskUNet(MaskUNetConfig())
        begin_with(net, path)
        return net.eval()
    networks = {"mask-unet": lambda width, **more: MaskUNet(MaskUNetConfig(width=width, **more))}
    return network_of(path, networks)


def load_device_checkpoint(path: Path) -> LineNet:
    """Read the checkpoint of ``training.devices`` beside its manifest, or an ONNX model's.

    Raises
    ------
    ModelError
        Damaged, or of another network.
    """
    if path.suffix == ".onnx":
        net = LineNet(LineNetConfig())
        devices_of(net, path)
        return net.eval()
    return network_of(path, {"line-net": lambda **config: LineNet(LineNetConfig(**config))})


class _CheckpointSession:
    """Answers as ``models.Session`` does, from checkpoints that were not exported."""

    def __init__(self, checkpoint: Path, devices: Path) -> None:
        told = load_device_checkpoint(devices)
        self.net = _Deployed(load_segmenter_checkpoint(checkpoint), told).eval()

    def run(
        self, inputs: Mapping[str, Array], *_: object, outputs: Sequence[str], **__: object
    ) -> list[Array]:
        with torch.no_grad():
            told = self.net(*(torch.from_numpy(inputs[name]) for name in INPUTS))
        return [told[OUTPUTS.index(name)].numpy() for name in outputs]


def checkpoint_segmenter(checkpoint: Path) -> Segmenter:
    """Open a checkpoint as if it were a model, with the shipped network of lines."""
    return Segmenter(cast(Session, _CheckpointSession(checkpoint, shipped())))


def shipped() -> Path:
    """Return the model that comes along: its network of lines is taken where no other is named.

    Raises
    ------
    UsageError
        None is installed.
    """
    if KIND.path is None:
        raise UsageError("no segmenter is installed whose network of lines could be taken")
    return KIND.path


def export_segmenter(
    checkpoint: Path, out: Path, pictures: int = 4, devices: Path | None = None
) -> float:
    """Write ``out`` (.onnx), its spec (.json) and its golden case.

    A network of lines that was trained on those of another segmenter is said on stderr.

    Parameters
    ----------
    checkpoint : of the segmenter, or an ONNX model whose segmenter is taken as it is
    out : the file
    pictures : generated ones that torch and ONNX Runtime are compared on
    devices : checkpoint of the network of lines, or an ONNX model that holds one; None: the model
        that comes along

    Returns
    -------
    Largest difference between torch and ONNX Runtime: of the probability, and of chords over
    1 + chord.

    Raises
    ------
    ModelError
        The ONNX file says something else than the checkpoint; what was at ``out`` stays.
    """
    devices = devices or shipped()
    net = _Deployed(load_segmenter_checkpoint(checkpoint), load_device_checkpoint(devices)).eval()
    example = torch.zeros(1, INPUT["channels"], 8 * STRIDE, 9 * STRIDE)
    points, near = torch.zeros(50, POINT), torch.zeros(50, NEAR, dtype=torch.int64)
    rows, cols = (torch.export.Dim(n, min=2, max=512) for n in ("rows", "cols"))
    count = torch.export.Dim("count", min=2, max=10**6)
    with quiet_tracing():
        program: Any = torch.onnx.export(
            net,
            (example, points, near),
            dynamo=True,
            verbose=False,
            opset_version=OPSET,
            external_data=False,
            input_names=list(INPUTS),
            output_names=list(OUTPUTS),
            dynamic_shapes=({2: STRIDE * rows, 3: STRIDE * cols}, {0: count}, {0: count}),
        )
    partial = out.with_name(f"{out.stem}.partial.onnx")
    new = not out.parent.exists()
    out.parent.mkdir(parents=True, exist_ok=True)
    # Of a run that was cut off here; it would be refused with another model.
    golden_path(partial).unlink(missing_ok=True)
    try:
        with quiet_tracing():
            _write(program, partial)
        training = _training(checkpoint, devices)
        _write_spec(training, partial, out.stem, net)
        worst = _largest_difference(net, partial, pictures)
        if worst > PARITY:
            raise ModelError(
                f"{out.name} differs from its checkpoint by {worst:.1e} (at most {PARITY:g})"
            )
        write_golden(partial, force=True)
        for made, place in zip(_files(partial), _files(out), strict=True):
            os.replace(made, place)
        _say_of_others_lines(training["devices"].get("segmenter"), devices, out)
    finally:
        for path in _files(partial):
            path.unlink(missing_ok=True)
        if new and not any(out.parent.iterdir()):
            out.parent.rmdir()
    return worst


def _say_of_others_lines(trained_on: str | None, devices: Path, out: Path) -> None:
    """Say that the network of lines knows those of another segmenter, if it does."""
    own = vessels_sha256(out)
    together = devices.suffix == ".onnx" and vessels_sha256(devices) == own
    if trained_on is not None and trained_on != own and not together:
        click.echo(
            f"note: the device network of {devices} was trained on lines of another segmenter "
            f"({trained_on[:12]}) than this one ({own[:12]}); train-devices --segmenter-model "
            f"{out} trains one for it",
            err=True,
        )


def _files(model: Path) -> tuple[Path, Path, Path]:
    """Return what one model consists of."""
    return golden_path(model), model.with_suffix(".json"), model


def _write(program: Any, path: Path) -> None:
    """Write the graph without what is of no use to a host."""
    import onnx

    program.save(str(path), external_data=False)
    model = onnx.load(str(path))
    model.ir_version = IR_VERSION
    for node in model.graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    del model.metadata_props[:]
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(path))


def _training(checkpoint: Path, devices: Path) -> dict[str, Any]:
    """Say what both were trained on, as the manifests or specs beside them do."""
    return trained_as(checkpoint) | {"devices": trained_as(devices, devices=True)}


def _write_spec(training: Mapping[str, Any], out: Path, name: str, net: torch.nn.Module) -> None:
    data = out.read_bytes()
    spec = {
        "schema": "gcar-model/1",
        "name": name,
        "kind": KIND.name,
        "inputs": dict(INPUT),
        "outputs": list(OUTPUTS),
        "opset": OPSET,
        "ir_version": IR_VERSION,
        "training": training,
        "license": license_of(training),
        "sha256": hashlib.sha256(data).hexdigest(),
        "bytes": len(data),
        "parameters": sum(p.numel() for p in net.parameters()),
    }
    out.with_suffix(".json").write_text(json.dumps(spec, indent=1) + "\n")


def _largest_difference(net: torch.nn.Module, out: Path, pictures: int) -> float:
    session = open_segmenter(out, threads=1)
    worst = 0.0
    for k in range(pictures):
        channels, truth = training_pair(PARITY_SEED, k)
        if k % 2:  # another shape than the one it was traced with
            whole = np.s_[:, : -3 * STRIDE, :-STRIDE]
            channels, truth = np.ascontiguousarray(channels[whole]), truth[whole]
        seen = session.look(channels)
        maps = np.concatenate([channels, seen.probability[None], seen.chord[None]])
        # The true lines: a network that has hardly learned sees none.
        lines = line_points(maps, skeletonize(truth[0] > 0.5), maps[0] > np.inf)
        given = (channels[None], lines.points, lines.near)
        with torch.no_grad():
            told = [m.numpy() for m in net(*map(torch.from_numpy, given))]
        difference = np.abs(told[0][0, 0] - seen.probability)
        relative = np.abs(told[1][0, 0] - seen.chord) / (1 + told[1][0, 0])
        devices = np.abs(told[2] - session.devices(lines))
        worst = max(worst, *(float(d.max()) for d in (difference, relative, devices)))
    return worst
