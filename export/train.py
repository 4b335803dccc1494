"""Train the multi-view centre predictor on generated trees, in pieces of any length.

A run is a folder: ``checkpoint.safetensors`` (weights, optimiser state, step), ``manifest.json``
(seed, options, versions, what was seen), ``log.csv`` and ``curve.png``. Scene i is a function of
(seed, i), the learning rate one of the step: a run that was stopped goes on to the bit.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import platform
import socket
import time
from pathlib import Path

import click
import numpy as np
import torch
import torch.distributed
import torch.multiprocessing
from safetensors.torch import load_file, save_file

from gcar_export.dataset import SceneOptions, TrainingScene, training_scene
from gcar_export.networks.sparse import SparseConfig, SparsePredictor

#: scenes with this seed are for choosing and reporting, never for training
VALIDATION_SEED = 90_001


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """Optimiser settings; the schedule is warm-up, constant, then linear to zero."""

    seed: int = 1
    steps: int = 5_250
    decay_steps: int = 3_250
    replicas: int = 2
    warmup_steps: int = 200
    learning_rate: float = 1.5e-3
    weight_decay: float = 1e-4
    clip: float = 1.0
    validation_scenes: int = 24
    save_every: int = 500


PRESETS = {
    "cpu": TrainOptions(),
    "gpu": TrainOptions(steps=120_000, decay_steps=30_000),
    "tiny": TrainOptions(
        replicas=1, steps=4, decay_steps=2, warmup_steps=1, validation_scenes=2, save_every=2
    ),
}


def learning_rate(options: TrainOptions, step: int) -> float:
    """Rate at ``step``: linear warm-up, constant, linear to zero over the last steps."""
    up = min(1.0, (step + 1) / options.warmup_steps)
    down = min(1.0, max(0.0, (options.steps - step) / max(options.decay_steps, 1)))
    return options.learning_rate * up * down


def inputs(scene: TrainingScene, device: str = "cpu") -> tuple:
    """Return the network's arguments for one scene as tensors."""
    e = scene.encoded

    def t(a: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(a).to(device)

    return (
        t(e.features),
        t(e.ray),
        t(e.ray_path),
        t(e.weight),
        [t(x) for x in e.neighbours],
        [t(x) for x in e.parent],
    )


def scene_loss(outputs: list[torch.Tensor], scene: TrainingScene) -> torch.Tensor:
    """Cross-entropy and soft Dice of every stage's occupancy; offset and radius of the last."""
    truth = torch.from_numpy(scene.occupancy).to(outputs[0].device)
    total = outputs[0].new_zeros(())
    for k, out in enumerate(outputs):
        logit = out[:, 0]
        p = torch.sigmoid(logit)
        bce = torch.nn.functional.binary_cross_entropy_with_logits(logit, truth)
        dice = 1 - (2 * (p * truth).sum() + 1) / ((p * p).sum() + (truth * truth).sum() + 1)
        total = total + (0.4 if k < len(outputs) - 1 else 1.0) * (bce + 0.5 * dice)
    near = (truth > 0.1) & (torch.from_numpy(scene.radius_cells) > 0)
    if bool(near.any()):
        last = outputs[-1][near]
        offset = torch.from_numpy(scene.offset_cells)[near]
        radius = torch.from_numpy(scene.radius_cells)[near]
        smooth = torch.nn.functional.smooth_l1_loss
        total = total + 0.15 * smooth(last[:, 1:4], offset, beta=0.5)
        total = total + 0.15 * smooth(last[:, 4], radius, beta=0.25)
    return total


@torch.no_grad()
def validate(net: SparsePredictor, scenes: list[TrainingScene]) -> dict[str, dict[str, float]]:
    """Dice at 0.5, and precision and recall within 1.5 cells, per kind of scene."""
    from scipy.spatial import cKDTree

    net.eval()
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for scene in scenes:
        p = torch.sigmoid(net(*inputs(scene))[-1][:, 0]).numpy()
        chosen, truth = p >= 0.5, scene.occupancy >= 0.5
        dice = 2 * (chosen & truth).sum() / max(chosen.sum() + truth.sum(), 1)
        reach = 1.5 * scene.spacing_mm
        precision = recall = 0.0
        if chosen.any() and truth.any():
            a, b = cKDTree(scene.points_mm[chosen]), cKDTree(scene.points_mm[truth])
            precision = (b.query(scene.points_mm[chosen])[0] <= reach).mean()
            recall = (a.query(scene.points_mm[truth])[0] <= reach).mean()
        rows.setdefault(scene.kind, []).append((dice, precision, recall))
    net.train()
    return {
        kind: dict(zip(("dice", "precision", "recall"), np.mean(v, axis=0).tolist(), strict=True))
        for kind, v in sorted(rows.items())
    }


def train(out: Path, options: TrainOptions, *, until: float | None = None) -> None:
    """Train or go on training in ``out``; stop after ``until`` seconds if given.

    Each step takes one scene per replica; replicas are processes of one thread each, which
    uses cores better than threads do on scenes of this size, and their gradients are averaged.
    """
    out.mkdir(parents=True, exist_ok=True)
    if options.replicas == 1:
        _replica(0, out, options, until, 0)
        return
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    torch.multiprocessing.spawn(
        _replica, args=(out, options, until, port), nprocs=options.replicas, join=True
    )


def _replica(rank: int, out: Path, options: TrainOptions, until: float | None, port: int) -> None:
    torch.set_num_threads(1 if options.replicas > 1 else torch.get_num_threads())
    if options.replicas > 1:
        torch.distributed.init_process_group(
            "gloo", init_method=f"tcp://127.0.0.1:{port}", rank=rank, world_size=options.replicas
        )
    torch.manual_seed(options.seed)
    net = SparsePredictor(SparseConfig()).train()
    optimiser = torch.optim.AdamW(
        net.parameters(), lr=options.learning_rate, weight_decay=options.weight_decay
    )
    step = _resume(out, net, optimiser)
    scene_options = SceneOptions()
    held_out = []
    if rank == 0:
        held_out = [
            training_scene(VALIDATION_SEED, i, scene_options)
            for i in range(options.validation_scenes)
        ]
    began, first, losses = time.time(), step, []
    while step < options.steps:
        out_of_time = until is not None and time.time() - began > until
        if _any(out_of_time, options.replicas):
            break
        scene = training_scene(options.seed, step * options.replicas + rank, scene_options)
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(options, step)
        loss = scene_loss(net(*inputs(scene)), scene)
        optimiser.zero_grad()
        loss.backward()
        _average(net, options.replicas)
        norm = torch.nn.utils.clip_grad_norm_(net.parameters(), options.clip)
        if bool(torch.isfinite(norm)):
            optimiser.step()
        losses.append(float(loss.detach()))
        step += 1
        if rank == 0 and step % 25 == 0:
            rate = (step - first) * options.replicas / (time.time() - began)
            click.echo(
                f"step {step}/{options.steps}  loss {np.mean(losses[-100:]):.4f}  "
                f"{rate:.2f} scenes/s",
                err=True,
            )
        if rank == 0 and (step % options.save_every == 0 or step == options.steps):
            _checkpoint(out, net, optimiser, step, options, losses, validate(net, held_out))
    if rank == 0:
        _checkpoint(out, net, optimiser, step, options, losses, None)
    if options.replicas > 1:
        torch.distributed.destroy_process_group()


def _any(flag: bool, replicas: int) -> bool:
    if replicas == 1:
        return flag
    shared = torch.tensor(float(flag))
    torch.distributed.all_reduce(shared)
    return bool(shared > 0)


def _average(net, replicas: int) -> None:
    if replicas == 1:
        return
    flat = torch.cat([p.grad.reshape(-1) for p in net.parameters()])
    torch.distributed.all_reduce(flat)
    flat /= replicas
    at = 0
    for p in net.parameters():
        p.grad.copy_(flat[at : at + p.numel()].view_as(p))
        at += p.numel()


def _resume(out: Path, net, optimiser) -> int:
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


def _checkpoint(out, net, optimiser, step, options, losses, scores) -> None:
    data = {f"net.{k}": v.detach().clone().contiguous() for k, v in net.state_dict().items()}
    for name, p in net.named_parameters():
        for key, value in optimiser.state.get(p, {}).items():
            data[f"opt.{name}.{key}"] = value.detach().clone().contiguous()
    data["step"] = torch.tensor(step)
    save_file(data, out / "checkpoint.tmp")
    os.replace(out / "checkpoint.tmp", out / "checkpoint.safetensors")
    manifest = {
        "schema": "gcar-training/1",
        "network": "sparse",
        "config": dataclasses.asdict(net.config),
        "options": dataclasses.asdict(options),
        "scenes": dataclasses.asdict(SceneOptions()),
        "data": "generated trees only: gcar_export.trees, scene step * replicas + rank of the seed",
        "step": step,
        "validation_seed": VALIDATION_SEED,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }
    if scores is not None:
        manifest["validation"] = scores
        new = not (out / "log.csv").exists()
        with (out / "log.csv").open("a", newline="") as f:
            writer = csv.writer(f)
            if new:
                writer.writerow(["step", "loss", "kind", "dice", "precision", "recall"])
            for kind, s in scores.items():
                row = [f"{s[k]:.4f}" for k in ("dice", "precision", "recall")]
                writer.writerow([step, f"{np.mean(losses[-250:]):.4f}", kind, *row])
        click.echo(
            f"step {step}  "
            + "  ".join(
                f"{k}: dice {v['dice']:.3f} p {v['precision']:.3f} r {v['recall']:.3f}"
                for k, v in scores.items()
            ),
            err=True,
        )
        (out / "manifest.json").write_text(json.dumps(manifest, indent=1) + "\n")


def start(
    out: Path,
    preset: str,
    *,
    steps: int | None = None,
    decay_steps: int | None = None,
    minutes: float | None = None,
) -> None:
    """Train with a preset, some of its numbers replaced."""
    options = PRESETS[preset]
    if steps:
        options = dataclasses.replace(options, steps=steps)
    if decay_steps:
        options = dataclasses.replace(options, decay_steps=decay_steps)
    train(out, options, until=minutes * 60 if minutes else None)
