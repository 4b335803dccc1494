"""Checkpoints: the safetensors file and the manifest beside it."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import torch

from gcar_export.shipping.export_onnx import load_checkpoint
from gcar_export.shipping.tiny_model import write_tiny_checkpoint
from tests.battery.damage import changed, damaged
from tests.battery.kinds.common import generator, outcome
from tests.battery.pool import Case, FoundError


def make(seed: int) -> Case:
    """Return the fuzz case of checkpoints."""
    with tempfile.TemporaryDirectory() as folder:
        original = write_tiny_checkpoint(Path(folder)).read_bytes()
        manifest = json.loads((Path(folder) / "manifest.json").read_text())

    def case(index: int, folder: Path) -> str:
        rng = generator("checkpoint", seed, index)
        other = rng.random() < 0.4
        path = folder / ("c.safetensors" if rng.random() < 0.95 else "c.pt")
        header = 8 + int.from_bytes(original[:8], "little")
        data = original
        if not other:  # the header decides everything, so most damage goes there
            part = header if rng.random() < 0.8 else len(original)
            data = damaged(original[:part], rng) + original[part:]
        path.write_bytes(data)
        text = json.dumps(changed(manifest, rng) if other else manifest).encode()
        text = damaged(text, rng) if rng.random() < 0.1 else text
        (folder / "manifest.json").write_bytes(text)
        return outcome(folder, (5,), lambda: _load(path))

    return case


def _load(path: Path) -> str:
    net = load_checkpoint(path)
    if not all(bool(torch.isfinite(p).all()) for p in net.parameters()):
        raise FoundError("weights that are not finite were accepted")
    return "loaded"
