"""Make the test model: a sparse predictor of a few hundred weights, from a seed.

``python -m gcar_export.tiny_model tests/data`` writes ``tiny.onnx`` with its spec and
golden case, through the same export as a real checkpoint, so tests exercise the true ONNX path
in milliseconds.
"""

from __future__ import annotations

import dataclasses
import json
import tempfile
from pathlib import Path

import click
import torch
from safetensors.torch import save_file

from gcar_export.dataset import training_scene
from gcar_export.export_onnx import export_sparse
from gcar_export.golden import write_golden
from gcar_export.networks.sparse import SparseConfig, SparsePredictor

TINY = SparseConfig(width=(3, 2, 2, 2), stages=1, ray_width=1)


def write_tiny_checkpoint(folder: Path, seed: int = 0) -> Path:
    """Write an untrained checkpoint with its manifest; returns its path."""
    torch.manual_seed(seed)
    net = SparsePredictor(TINY)
    save_file(
        {f"net.{k}": v.contiguous() for k, v in net.state_dict().items()},
        folder / "checkpoint.safetensors",
    )
    manifest = {
        "schema": "gcar-training/1",
        "network": "sparse",
        "config": dataclasses.asdict(TINY),
        "step": 0,
        "data": "untrained",
    }
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder / "checkpoint.safetensors"


@click.command()
@click.argument("out", type=click.Path(path_type=Path, file_okay=False))
def main(out: Path) -> None:
    """Write tiny.onnx and tiny.json into OUT."""
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = write_tiny_checkpoint(Path(folder))
        spec = export_sparse(checkpoint, out / "tiny.onnx", training_scene(0, 0).encoded)
    write_golden(out / "tiny.onnx", force=True)
    click.echo(f"{out / 'tiny.onnx'}: {spec['bytes']} bytes, {spec['parameters']} parameters")


if __name__ == "__main__":
    main()
