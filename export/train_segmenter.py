"""Train the segmentation network on generated angiograms, in pieces of any length.

A run is a folder: ``checkpoint.safetensors`` (weights, optimiser state, step), ``manifest.json``
(options, versions, scores), ``log.csv``. Picture i is a function of (seed, i), the learning rate
one of the step: a run that was stopped goes on where it was.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import platform
import sys
import time
from pathlib import Path

import click
import cv2
import numpy as np
import torch
from safetensors.torch import load_file, save_file

from gcar_deploy.config import ImagingOptions
from gcar_export.angiograms import training_pair
from gcar_export.networks.mask_unet import MaskUNet, MaskUNetConfig

#: pictures with this seed are for choosing and reporting, never for training
VALIDATION_SEED = 90_002


@dataclasses.dataclass(frozen=True)
class SegmenterOptions:
    """Optimiser settings; the schedule is warm-up, constant, then linear to zero."""

    seed: int = 1
    steps: int = 1500
    decay_steps: int = 600
    warmup_steps: int = 30
    batch: int = 3
    learning_rate: float = 4e-3
    weight_decay: float = 1e-4
    validation_pictures: int = 24
    save_every: int = 50


TINY = SegmenterOptions(
    steps=3, decay_steps=1, warmup_steps=1, batch=1, validation_pictures=2, save_every=2
)


def learning_rate(options: SegmenterOptions, step: int) -> float:
    """Rate at ``step``: linear warm-up, constant, linear to zero over the last steps."""
    up = min(1.0, (step + 1) / options.warmup_steps)
    down = min(1.0, max(0.0, (options.steps - step) / max(options.decay_steps, 1)))
    return options.learning_rate * up * down


def mask_loss(logits: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Cross-entropy plus soft Dice over each picture (Milletari et al. 2016)."""
    bce = torch.nn.functional.binary_cross_entropy_with_logits(logits, truth)
    p = torch.sigmoid(logits)
    both = (p * truth).sum((1, 2, 3))
    dice = 1 - (2 * both + 1) / (p.sum((1, 2, 3)) + truth.sum((1, 2, 3)) + 1)
    return bce + dice.mean()


def batch(
    options: SegmenterOptions, seed: int, first: int, count: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Pictures ``first`` .. of a stream: (count, 2, n, n) inputs and (count, 1, n, n) truths."""
    pairs = [training_pair(seed, first + k, ImagingOptions()) for k in range(count)]
    x, y = (np.stack(part) for part in zip(*pairs, strict=True))
    return torch.from_numpy(x), torch.from_numpy(y)[:, None]


@torch.no_grad()
def validate(net: MaskUNet, options: SegmenterOptions) -> float:
    """Mean Dice at 0.5 over held-out generated pictures."""
    net.eval()
    scores = []
    for k in range(options.validation_pictures):
        x, y = batch(options, VALIDATION_SEED, k, 1)
        found, true = torch.sigmoid(net(x)) >= 0.5, y >= 0.5
        both = float((found & true).sum())
        scores.append(2 * both / max(float(found.sum() + true.sum()), 1.0))
    net.train()
    return float(np.mean(scores))


def train(out: Path, options: SegmenterOptions, *, minutes: float | None = None) -> None:
    """Train or go on training in ``out``; stop after ``minutes`` if given.

    The decay is a function of the step, so a run cut short has not settled: ``finish`` it by a
    call with fewer ``steps``.
    """
    out.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(1)
    torch.manual_seed(options.seed)
    net = MaskUNet(MaskUNetConfig()).train()
    optimiser = torch.optim.AdamW(
        net.parameters(), lr=options.learning_rate, weight_decay=options.weight_decay
    )
    step = _resume(out, net, optimiser)
    began, losses = time.time(), []
    with click.progressbar(length=options.steps, label="segmenter", file=sys.stderr) as bar:
        bar.update(step)
        while step < options.steps:
            if minutes is not None and time.time() - began > 60 * minutes:
                break
            for group in optimiser.param_groups:
                group["lr"] = learning_rate(options, step)
            x, y = batch(options, options.seed, step * options.batch, options.batch)
            loss = mask_loss(net(x), y)
            optimiser.zero_grad()
            loss.backward()
            norm = torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            if bool(torch.isfinite(norm)):
                optimiser.step()
            losses.append(float(loss.detach()))
            step += 1
            bar.update(1)
            if step % options.save_every == 0:
                _checkpoint(out, net, optimiser, step, options, losses, None)
    _checkpoint(out, net, optimiser, step, options, losses, validate(net, options))


def _resume(out: Path, net: MaskUNet, optimiser: torch.optim.Optimizer) -> int:
    path = out / "checkpoint.safetensors"
    if not path.exists():
        return 0
    data = load_file(path)
    net.load_state_dict({k[4:]: v for k, v in data.items() if k.startswith("net.")})
    state = {}
    for n, (name, _) in enumerate(net.named_parameters()):
        if f"opt.{name}.exp_avg" in data:
            state[n] = {k: data[f"opt.{name}.{k}"] for k in ("exp_avg", "exp_avg_sq", "step")}
    groups = optimiser.state_dict()["param_groups"]
    optimiser.load_state_dict({"state": state, "param_groups": groups})
    return int(data["step"])


def _checkpoint(out, net, optimiser, step, options, losses, dice) -> None:
    data = {f"net.{k}": v.detach().clone().contiguous() for k, v in net.state_dict().items()}
    for name, p in net.named_parameters():
        for key, value in optimiser.state.get(p, {}).items():
            data[f"opt.{name}.{key}"] = value.detach().clone().contiguous()
    data["step"] = torch.tensor(step)
    save_file(data, out / "checkpoint.tmp")
    os.replace(out / "checkpoint.tmp", out / "checkpoint.safetensors")
    manifest = {
        "schema": "gcar-training/1",
        "network": "mask-unet",
        "config": dataclasses.asdict(net.config),
        "options": dataclasses.asdict(options),
        "data": "generated angiograms only: gcar_export.angiograms, picture step * batch + k",
        "step": step,
        "validation_seed": VALIDATION_SEED,
        "validation_dice": dice,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }
    (out / "manifest.json").write_text(json.dumps(manifest, indent=1) + "\n")
    new = not (out / "log.csv").exists()
    with (out / "log.csv").open("a", newline="") as f:
        writer = csv.writer(f)
        if new:
            writer.writerow(["step", "loss", "dice"])
        recent = f"{np.mean(losses[-50:]):.4f}" if losses else ""
        writer.writerow([step, recent, "" if dice is None else f"{dice:.4f}"])
