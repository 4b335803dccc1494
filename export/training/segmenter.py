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
from collections.abc import Iterator, Sequence
from pathlib import Path

import click
import cv2
import numpy as np
import torch
from safetensors.torch import load_file, save_file

from gcar_export.scenes.angiograms import training_pair
from gcar_export.training.networks.mask_unet import MaskUNet, MaskUNetConfig

#: pictures with this seed are for choosing and reporting, never for training
VALIDATION_SEED = 90_002


@dataclasses.dataclass(frozen=True)
class SegmenterOptions:
    """Optimiser settings; the schedule is warm-up, constant, then linear to zero.

    Attributes
    ----------
    lenient_from : int, step from which devices are rarer and count less: first what a line of
        contrast is, then not to lose a vessel to a look-alike
    bfloat16 : bool, the network's layers in half the bits, its weights in single precision
    """

    seed: int = 1
    steps: int = 2500
    decay_steps: int = 1700
    warmup_steps: int = 50
    batch: int = 8
    learning_rate: float = 2e-3
    weight_decay: float = 1e-4
    validation_pictures: int = 40
    save_every: int = 50
    bfloat16: bool = True
    lenient_from: int = 1800


TINY = SegmenterOptions(
    steps=3, decay_steps=1, warmup_steps=1, batch=1, validation_pictures=2, save_every=2
)


def learning_rate(options: SegmenterOptions, step: int) -> float:
    """Rate at ``step``: linear warm-up, constant, linear to zero over the last steps."""
    up = min(1.0, (step + 1) / options.warmup_steps)
    down = min(1.0, max(0.0, (options.steps - step) / max(options.decay_steps, 1)))
    return options.learning_rate * up * down


def mask_loss(logits: torch.Tensor, truth: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Cross-entropy plus soft Dice over each picture (Milletari et al. 2016).

    All (n, rows, cols); pixels of weight 0 are asked neither way.
    """
    bce = torch.nn.functional.binary_cross_entropy_with_logits(logits, truth, weight=weight)
    p = torch.sigmoid(logits) * weight
    both = (p * truth).sum((1, 2))
    dice = 1 - (2 * both + 1) / (p.sum((1, 2)) + (truth * weight).sum((1, 2)) + 1)
    return bce + dice.mean()


def chord_loss(chords: torch.Tensor, truth: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Relative error of (n, rows, cols) chords in pixel edges, on the scale of log(1 + chord).

    Summed over all pixels, per pixel of vessel: what is no vessel must have no chord. A weight
    between 0 and 1 holds here as well; where the mask is unsure (0) the chord is not.
    """
    error = torch.nn.functional.smooth_l1_loss(
        torch.log1p(chords), torch.log1p(truth), beta=0.1, reduction="none"
    )
    error = error * torch.where(weight > 0, weight, 1.0)
    return (error.sum((1, 2)) / ((truth > 0.25).sum((1, 2)) + 500)).mean()


def total_loss(out: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Of (n, 2, rows, cols) answers against (n, 3, rows, cols) truths of ``training_pair``."""
    mask, weight, chord = truth.unbind(1)
    return mask_loss(out[:, 0], mask, weight) + 2 * chord_loss(out[:, 1], chord, weight)


class Stream(torch.utils.data.Dataset):
    """Pictures 0 .. of a stream, made where and when they are asked for."""

    def __init__(self, seed: int, length: int, lenient_from: int) -> None:
        self.seed, self.length, self.lenient_from = seed, length, lenient_from

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        cv2.setNumThreads(1)
        x, y = training_pair(self.seed, index, index >= self.lenient_from)
        return torch.from_numpy(x), torch.from_numpy(y)


def batches(
    options: SegmenterOptions, first_step: int, workers: int
) -> Iterator[list[torch.Tensor]]:
    """Yield inputs and truths, both (batch, 3, n, n), of each step from ``first_step`` on."""
    stream = Stream(
        options.seed, options.steps * options.batch, options.lenient_from * options.batch
    )
    order = [
        list(range(k * options.batch, (k + 1) * options.batch))
        for k in range(first_step, options.steps)
    ]
    yield from torch.utils.data.DataLoader(stream, batch_sampler=order, num_workers=workers)


@torch.no_grad()
def validate(net: MaskUNet, options: SegmenterOptions) -> float:
    """Mean Dice at 0.5 over held-out generated pictures."""
    net.eval()
    scores = []
    stream = Stream(VALIDATION_SEED, options.validation_pictures, options.validation_pictures)
    for k in range(options.validation_pictures):
        x, y = stream[k]
        asked = y[1] > 0
        found, true = (net(x[None])[0, 0] >= 0) & asked, (y[0] >= 0.5) & asked
        both = float((found & true).sum())
        scores.append(2 * both / max(float(found.sum() + true.sum()), 1.0))
    net.train()
    return float(np.mean(scores))


def train(
    out: Path, options: SegmenterOptions, *, minutes: float | None = None, workers: int = 1
) -> None:
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
        for x, y in batches(options, step, workers):
            if minutes is not None and time.time() - began > 60 * minutes:
                break
            for group in optimiser.param_groups:
                group["lr"] = learning_rate(options, step)
            with torch.autocast("cpu", torch.bfloat16, enabled=options.bfloat16):
                out_maps = net(x)
            loss = total_loss(out_maps.float(), y)
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


def _checkpoint(
    out: Path, net: MaskUNet, optimiser: torch.optim.Optimizer, step: int,
    options: SegmenterOptions, losses: Sequence[float], dice: float | None,
) -> None:  # fmt: skip
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
        "data": "generated angiograms: gcar_export.scenes.angiograms, picture step * batch + k",
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
