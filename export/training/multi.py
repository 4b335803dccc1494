"""Train the multi-view centre predictor on generated trees, in pieces of any length.

Scene i is a function of (seed, i), the learning rate one of the step: a run that was stopped goes
on to the bit (see ``run_folder``).
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import multiprocessing.connection
import os
import socket
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
import torch.distributed
import torch.multiprocessing

from gcar_deploy import errors
from gcar_deploy.errors import GcarError, ModelError
from gcar_export.scenes.capsules import LabelTree
from gcar_export.training.dataset import TrainingScene, training_scene
from gcar_export.training.examinations import SceneOptions
from gcar_export.training.loop import learning_rate, precision
from gcar_export.training.mean_weights import MeanWeights
from gcar_export.training.networks.sparse import SparseConfig, SparsePredictor
from gcar_export.training.run_folder import (
    Flag,
    ProgressLine,
    RunFolder,
    alone,
    heeding,
    until_interrupted,
)
from gcar_export.training.scene_stream import in_order, leave_interrupts_to_the_parent
from gcar_export.training.warm_start import inherited, predictor_of

#: scenes with this seed are for choosing and reporting, never for training
VALIDATION_SEED = 90_001
GENERATED = "generated trees alone (gcar_export.scenes.trees)"


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """Optimiser settings; the schedule is warm-up, constant, then linear to zero."""

    seed: int = 1
    steps: int = 24_000
    decay_steps: int = 14_000
    replicas: int = 2
    warmup_steps: int = 200
    learning_rate: float = 1.5e-3
    weight_decay: float = 1e-4
    clip: float = 1.0
    validation_scenes: int = 24
    save_every: int = 500
    #: what is kept is the mean of the weights over about so many steps (``mean_weights``)
    mean_steps: int = 1000
    device: str = "cpu"
    #: forward pass in bfloat16; the loss stays in float32
    bf16: bool = False
    compiled: bool = False
    #: processes per replica that draw scenes ahead; 0 draws each when its turn comes
    workers: int = 0


PRESETS = {
    "cpu": TrainOptions(),
    #: 40 minutes of a device that is fed by 16 cores
    "gpu": TrainOptions(
        steps=60_000,
        decay_steps=30_000,
        replicas=1,
        device="cuda",
        bf16=True,
        compiled=True,
        workers=14,
        save_every=2_000,
    ),
    #: from a model that is there (``warm_start``)
    "tune": TrainOptions(
        steps=4_000, decay_steps=3_800, warmup_steps=100, learning_rate=4e-4, save_every=120
    ),
    "tiny": TrainOptions(
        replicas=1, steps=4, decay_steps=2, warmup_steps=1, validation_scenes=2, save_every=2
    ),
}

CONFIGS = {
    "cpu": SparseConfig(),
    "gpu": SparseConfig(),
    "tune": SparseConfig(),
    "tiny": SparseConfig(width=(3, 2, 2, 2), stages=1, ray_width=1),
}


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
    radius = torch.from_numpy(scene.radius_cells).to(truth.device)
    near = (truth > 0.1) & (radius > 0)
    if bool(near.any()):
        last, radius = outputs[-1][near], radius[near]
        offset = torch.from_numpy(scene.offset_cells).to(truth.device)[near]
        smooth = torch.nn.functional.smooth_l1_loss
        total = total + 0.15 * smooth(last[:, 1:4], offset, beta=0.5)
        total = total + 0.15 * smooth(last[:, 4], radius, beta=0.25)
    return total


@torch.no_grad()
def validate(net: SparsePredictor, scenes: Iterable[TrainingScene]) -> dict[str, dict[str, float]]:
    """Dice at 0.5, and precision and recall within 1.5 cells, per kind of scene."""
    from scipy.spatial import cKDTree

    net.eval()
    device = str(next(net.parameters()).device)
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for scene in scenes:
        p = torch.sigmoid(net(*inputs(scene, device))[-1][:, 0]).cpu().numpy()
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


@dataclasses.dataclass(frozen=True)
class _Job:
    """What every replica needs to know."""

    out: Path
    options: TrainOptions
    config: SparseConfig
    until: float | None
    labels: tuple[LabelTree, ...]
    label_hashes: Mapping[str, str]
    warm_start: Path | None = None
    port: int = 0


def train(
    out: Path,
    options: TrainOptions,
    config: SparseConfig | None = None,
    *,
    until: float | None = None,
    labels: Sequence[LabelTree] = (),
    label_hashes: Mapping[str, str] | None = None,
    warm_start: Path | None = None,
) -> None:
    """Train or go on training in ``out``; stop after ``until`` seconds if given.

    The first step begins from random weights, or from those of the model ``warm_start``.

    Each step takes one scene per replica; replicas are processes of one thread each, which
    uses cores better than threads do on scenes of this size, and their gradients are averaged.

    Raises
    ------
    UsageError
        ``out`` holds a run of another network, size, seed, set of labels or first weights.
    ModelError
        ``warm_start`` is no multi-view predictor, or one of another size.
    KeyboardInterrupt
        On Ctrl-C or SIGTERM, when the run is saved.
    """
    job = _Job(
        out, options, config or SparseConfig(), until, tuple(labels), dict(label_hashes or {}),
        warm_start,
    )  # fmt: skip
    run = _run_folder(job)
    if run.finished(options.steps):
        return
    # One process asks the flag that its own signal raises: a shared one, which locks, would hang.
    shared = torch.multiprocessing.get_context("spawn").Event() if options.replicas > 1 else None
    with alone([run]), until_interrupted(shared) as stop:
        _replicas(job, stop)


def _replicas(job: _Job, stop: Flag) -> None:
    count = job.options.replicas
    if count == 1:
        _replica(0, job, stop)
        return
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        job = dataclasses.replace(job, port=probe.getsockname()[1])
    try:
        torch.multiprocessing.spawn(_replica, args=(job, stop), nprocs=count, join=True)
    except torch.multiprocessing.ProcessRaisedException as error:
        raise _reason_of(error) from error


def _reason_of(error: Exception) -> GcarError:
    """Return what a replica said in the last line of its traceback, as the error that it was."""
    kind, _, text = str(error).strip().splitlines()[-1].partition(": ")
    own = getattr(errors, kind.removeprefix(f"{errors.__name__}."), None)
    return own(text) if own else GcarError(f"a replica ended: {kind} {text}".rstrip())


def _end_with_parent() -> None:
    """End this process as soon as the one that started it is gone, however that ended.

    A replica that trains on alone would write into the folder of the run that replaced it.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _replica(rank: int, job: _Job, stop: Flag) -> None:
    _end_with_parent()
    options, scenes = job.options, SceneOptions()
    if options.replicas > 1:
        leave_interrupts_to_the_parent()
    torch.set_num_threads(1 if options.replicas > 1 else torch.get_num_threads())
    if options.replicas > 1:
        torch.distributed.init_process_group(
            "gloo",
            init_method=f"tcp://127.0.0.1:{job.port}",
            rank=rank,
            world_size=options.replicas,
        )
    run = _run_folder(job)
    torch.manual_seed(options.seed)
    net = _first_network(job).to(options.device).train()
    optimiser = torch.optim.AdamW(
        net.parameters(), lr=options.learning_rate, weight_decay=options.weight_decay
    )
    mean = MeanWeights(net, options.mean_steps)
    step = run.resume(net, optimiser, mean.net)
    drawn_once = functools.cache(lambda i: training_scene(VALIDATION_SEED, i, scenes))

    def save_and_score() -> None:
        due = step > 0 and (step % options.save_every == 0 or step == options.steps)
        if rank or not due or run.scored(step):
            return
        run.save(net, optimiser, step, mean=mean.net)
        # The other replicas wait: the flag ends them all at the head of the loop.
        with contextlib.suppress(KeyboardInterrupt):
            held_out = map(drawn_once, heeding(stop, range(options.validation_scenes)))
            scores = validate(mean.net, held_out)
            run.log(step, scores, scores)
            _tell(step, scores)

    # The run before may have ended while it was scored.
    save_and_score()
    # Every scene has another number of points: shapes stay symbols in the compiled graph.
    forward = torch.compile(net, dynamic=True) if options.compiled else net
    line = ProgressLine(step, options.steps, options.replicas, "scenes")
    began = time.monotonic()
    draw = functools.partial(training_scene, options.seed, options=scenes, labels=job.labels)
    numbers = range(
        step * options.replicas + rank, options.steps * options.replicas, options.replicas
    )
    with in_order(draw, numbers, options.workers) as drawn:
        while step < options.steps:
            out_of_time = job.until is not None and time.monotonic() - began > job.until
            if _any(out_of_time or stop.is_set(), options.replicas):
                break
            scene = next(drawn)
            for group in optimiser.param_groups:
                group["lr"] = learning_rate(options, step)
            with precision(options.device, options.bf16):
                outputs = forward(*inputs(scene, options.device))
            loss = scene_loss([o.float() for o in outputs], scene)
            optimiser.zero_grad()
            loss.backward()
            _average(net, options.replicas)
            norm = torch.nn.utils.clip_grad_norm_(net.parameters(), options.clip)
            if bool(torch.isfinite(norm)):
                optimiser.step()
            run.took(float(loss.detach()))
            step += 1
            mean.add(net, step)
            if rank == 0:
                line.show(step, run.losses)
            save_and_score()
    if rank == 0:
        run.save(net, optimiser, step, mean=mean.net)
        if step < options.steps or stop.is_set():
            run.interrupt(step)
    if options.replicas > 1:
        torch.distributed.destroy_process_group()


def _first_network(job: _Job) -> SparsePredictor:
    net = SparsePredictor(job.config)
    if job.warm_start is not None:
        first, _ = predictor_of(job.warm_start)
        if first.config != job.config:
            raise ModelError(f"{job.warm_start.name} holds {first.config}, not {job.config}")
        net.load_state_dict(first.state_dict())
    return net


def _run_folder(job: _Job) -> RunFolder:
    before: dict[str, Any] = {"warm_start": None}
    if job.warm_start is not None:
        before = inherited(predictor_of(job.warm_start)[1])
    labelled = job.labels or before.get("labels_before")
    return RunFolder(
        job.out,
        {
            "network": "sparse",
            "config": dataclasses.asdict(job.config),
            "seed": job.options.seed,
            "options": dataclasses.asdict(job.options),
            "scenes": dataclasses.asdict(SceneOptions()),
            "labels": dict(job.label_hashes),
            **before,
            "data": f"{'generated trees and label volumes' if labelled else GENERATED}: "
            "scene step * replicas + rank of the seed",
            "validation_seed": VALIDATION_SEED,
        },
    )


def _tell(step: int, scores: Mapping[str, Mapping[str, float]]) -> None:
    shown = "  ".join(
        f"{k}: dice {v['dice']:.3f} p {v['precision']:.3f} r {v['recall']:.3f}"
        for k, v in scores.items()
    )
    click.echo(f"step {step}  {shown}", err=True)


def _any(flag: bool, replicas: int) -> bool:
    if replicas == 1:
        return flag
    shared = torch.tensor(float(flag))
    torch.distributed.all_reduce(shared)
    return bool(shared > 0)


def _average(net: torch.nn.Module, replicas: int) -> None:
    if replicas == 1:
        return
    flat = torch.cat([p.grad.reshape(-1) for p in net.parameters()])  # type: ignore[union-attr]
    torch.distributed.all_reduce(flat)
    flat /= replicas
    at = 0
    for p in net.parameters():
        p.grad.copy_(flat[at : at + p.numel()].view_as(p))  # type: ignore[union-attr]
        at += p.numel()
