"""Make the test models: one of each kind with a few hundred weights, from a seed.

``python -m gcar_export.shipping.tiny_model tests/data`` writes ``tiny.onnx`` and
``tiny-paper.onnx`` with their specs and golden cases, through the same export as real
checkpoints, so tests exercise the true ONNX path in milliseconds.
"""

from __future__ import annotations

import dataclasses
import json
import tempfile
from pathlib import Path

import click
import torch
from safetensors.torch import save_file

from gcar_export.shipping.export_onnx import export_model
from gcar_export.shipping.golden import write_golden
from gcar_export.training.networks.sparse import SparseConfig, SparsePredictor
from gcar_export.training.networks.unet import UNetConfig, UNetPredictor

TINY = SparseConfig(width=(3, 2, 2, 2), stages=1, ray_width=1)
TINY_PAPER = UNetConfig(pixels=64, alpha=2, width=(4, 4), pose=True)


def write_tiny_checkpoint(folder: Path, seed: int = 0, network: str = "sparse") -> Path:
    """Write an untrained checkpoint of a network with its manifest; returns its path."""
    torch.manual_seed(seed)
    net = SparsePredictor(TINY) if network == "sparse" else UNetPredictor(TINY_PAPER)
    save_file(
        {f"net.{k}": v.contiguous() for k, v in net.state_dict().items()},
        folder / "checkpoint.safetensors",
    )
    manifest = {
        "schema": "gcar-training/1",
        "network": network,
        "config": dataclasses.asdict(net.config),
        "step": 0,
        "data": "untrained",
        "options": {"usual": True},
    }
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder / "checkpoint.safetensors"


@click.command()
@click.argument("out", type=click.Path(path_type=Path, file_okay=False))
def main(out: Path) -> None:
    """Write the tiny models into OUT."""
    for network, name in (("sparse", "tiny.onnx"), ("unet", "tiny-paper.onnx")):
        with tempfile.TemporaryDirectory() as folder:
            checkpoint = write_tiny_checkpoint(Path(folder), network=network)
            spec = export_model(checkpoint, out / name)
        write_golden(out / name, force=True)
        click.echo(f"{out / name}: {spec['bytes']} bytes, {spec['parameters']} parameters")


if __name__ == "__main__":
    main()
