"""Train the paper's Gaussian centre predictor, in pieces of any length.

Pictures of step k are a function of (seed, k), the learning rate and the Chamfer weight of the
step: a run that was stopped goes on to the bit (see ``run_folder``).
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch

from gcar_deploy.predict.center_map import DEPTH_PIXELS, decode
from gcar_export.scenes.capsules import LabelTree
from gcar_export.training import losses
from gcar_export.training.loop import learning_rate, precision
from gcar_export.training.networks.unet import UNetConfig, UNetPredictor
from gcar_export.training.paper_dataset import POSES, VIEWS, TrainingPicture, training_pictures
from gcar_export.training.run_folder import (
    Flag,
    ProgressLine,
    RunFolder,
    alone,
    heeding,
    until_interrupted,
)

#: trees with this seed are for choosing and reporting, never for training
VALIDATION_SEED = 90_002
#: half of the picture's field is one unit of length in Chamfer and clDice
_UNIT_PIXELS = 64.0


@dataclasses.dataclass(frozen=True)
class PaperTraining:
    """Optimiser settings; the rate warms up, stays, then falls linearly to zero."""

    seed: int = 1
    steps: int = 4_500
    decay_steps: int = 3_825
    trees: int = 4
    warmup_steps: int = 200
    learning_rate: float = 1.5e-3
    weight_decay: float = 1e-4
    clip: float = 10.0
    #: see ``losses.chamfer_weight``; the paper's 20,000 scaled to the length of the run
    chamfer_schedule: str = "clamp"
    chamfer_start: int = 1_800
    #: see ``losses.depth_loss``
    depth_terms: str = "mean"
    #: views usual in practice in place of the paper's two
    usual: bool = False
    #: clDice on a cube of so many voxels, of so many of a step's pictures
    cldice_voxels: int = 32
    cldice_pictures: int = 1
    cldice_iterations: int = 1
    validation_trees: int = 20
    save_every: int = 250
    device: str = "cpu"
    #: forward pass in bfloat16; losses stay in float32
    bf16: bool = True
    compiled: bool = False


PRESETS = {
    "cpu": PaperTraining(),
    "gpu": PaperTraining(
        steps=100_000, decay_steps=40_000, trees=16, chamfer_start=losses.PAPER_START,
        cldice_voxels=128, cldice_pictures=8, cldice_iterations=4, save_every=2_000,
        device="cuda", bf16=True, compiled=True,
    ),
    "tiny": PaperTraining(
        steps=4, decay_steps=2, trees=1, warmup_steps=1, chamfer_start=1, cldice_voxels=16,
        validation_trees=1, save_every=2,
    ),
}  # fmt: skip
CONFIGS = {
    "cpu": UNetConfig(width=(8, 16, 32, 96, 128, 160), pose=True),
    "gpu": UNetConfig(width=(16, 32, 64, 96, 128, 160), pose=True),
    "tiny": UNetConfig(pixels=64, alpha=4, width=(4, 4)),
}


@dataclasses.dataclass(eq=False)
class Batch:
    """Pictures of one step as tensors; ``b`` pictures of n x n pixels and m x m cells.

    Attributes
    ----------
    pictures : (b, 1, n, n); depth, known, cells : (b, m, m); rays : (b, m, m, 3)
        Rays in the axes of each view (column, row, source to detector).
    middle : (b,) distance of source and isocentre, and source : (b, 3), both in units of 64 pixels
    points : per picture (k, 3) of the true lumen, units of 64 pixels, axes of the view
    axes : (b, 3, 3) axes of the views, rows
    """

    pictures: torch.Tensor
    depth: torch.Tensor
    known: torch.Tensor
    cells: torch.Tensor
    rays: torch.Tensor
    source: torch.Tensor
    points: list[torch.Tensor]
    axes: torch.Tensor

    @staticmethod
    def of(drawn: Sequence[TrainingPicture], alpha: int, device: str | torch.device) -> Batch:
        """Stack pictures and their truth."""

        def stack(arrays: Sequence[Any], kind: Any = np.float32) -> torch.Tensor:
            return torch.from_numpy(np.stack([np.asarray(a, kind) for a in arrays])).to(device)

        axes = [p.picture.carm.axes for p in drawn]
        units = [_UNIT_PIXELS * p.picture.pixel_mm for p in drawn]
        return Batch(
            pictures=stack([p.picture.network_input()[0] for p in drawn]),
            depth=stack([p.depth for p in drawn]),
            known=stack([p.known for p in drawn], bool),
            cells=stack([p.picture.cells(alpha) for p in drawn], bool),
            rays=stack([p.picture.rays(alpha) @ a.T for p, a in zip(drawn, axes, strict=True)]),
            source=stack([a @ p.picture.carm.source_mm / u for p, a, u in zip(drawn, axes, units)]),  # noqa: B905
            points=[
                torch.from_numpy((p.points_mm @ a.T / u).astype(np.float32)).to(device)
                for p, a, u in zip(drawn, axes, units, strict=True)
            ],
            axes=stack(axes),
        )

    def centers(self, out: torch.Tensor, k: int) -> torch.Tensor:
        """(n, 3) centres of picture ``k``, differentiable twin of ``center_map.decode``."""
        inside = self.cells[k]
        t = self.source[k].norm() + (out[k, 0][inside] - 0.5) * (DEPTH_PIXELS / _UNIT_PIXELS)
        offset = out[k, 1:, inside].T / _UNIT_PIXELS
        return self.source[k] + t[:, None] * self.rays[k][inside] + offset


def batch_loss(
    out: torch.Tensor, batch: Batch, step: int, options: PaperTraining
) -> tuple[torch.Tensor, dict[str, int]]:
    """Mean over pictures of the paper's loss; and how many pictures each term had to leave out."""
    gamma1 = losses.chamfer_weight(step, options.chamfer_start, options.chamfer_schedule)
    left_out = {"depth": 0, "chamfer": 0}
    total = out.new_zeros(())
    n = len(out)
    for k in range(n):
        depth = losses.depth_loss(out[k, 0], batch.depth[k], batch.known[k], options.depth_terms)
        if depth is None:
            left_out["depth"] += 1
        else:
            total = total + losses.depth_weight(options.depth_terms) * depth / n
        if gamma1 > 0:
            distance = losses.chamfer(batch.centers(out, k), batch.points[k])
            if distance is None:
                left_out["chamfer"] += 1
            else:
                total = total + gamma1 * distance / n
    # Far from the truth skeletons never meet and their slope is noise: like Chamfer, clDice waits
    # for the end of the warm-up. It costs more than all the rest, so a few pictures stand for all.
    wanted = min(options.cldice_pictures, n) if gamma1 > 0 else 0
    chosen = [(step + j) % n for j in range(wanted)]
    for k in chosen:
        made = losses.splat(batch.centers(out, k), options.cldice_voxels)
        true = losses.splat(batch.points[k], options.cldice_voxels)
        overlap = losses.skeleton_dice_loss(made, true, options.cldice_iterations)
        total = total + losses.GAMMA_CLDICE * overlap / len(chosen)
    return total, left_out


@torch.no_grad()
def validate(
    net: UNetPredictor, pictures: Iterable[TrainingPicture]
) -> dict[str, dict[str, float]]:
    """Per kind: share of centres within 1.5 pixels of the centreline and back; depth error.

    The centreline counted for recall is the part inside the picture; the depth error is the
    median absolute one, in pixel edges.
    """
    from scipy.spatial import cKDTree

    net.eval()
    device = next(net.parameters()).device
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for p in pictures:
        seen = Batch.of([p], net.config.alpha, device)
        out = net(seen.pictures, seen.axes)[0].float().cpu().numpy()
        centers = decode(out, p.picture, net.config.alpha).points_mm
        reach = 1.5 * p.picture.pixel_mm
        precision = (cKDTree(p.centerline_mm).query(centers)[0] <= reach).mean()
        recall = (cKDTree(centers).query(p.centerline_mm)[0] <= reach).mean()
        wrong = np.median(np.abs(out[0] - p.depth)[p.known]) * DEPTH_PIXELS
        rows.setdefault(p.kind, []).append((float(precision), float(recall), float(wrong)))
    net.train()
    names = ("precision", "recall", "depth_error")
    return {
        kind: dict(zip(names, np.mean(v, axis=0).tolist(), strict=True))
        for kind, v in sorted(rows.items())
    }


def train(
    out: Path,
    options: PaperTraining,
    config: UNetConfig,
    *,
    until: float | None = None,
    labels: Sequence[LabelTree] = (),
    label_hashes: Mapping[str, str] | None = None,
) -> None:
    """Train or go on training in ``out``; stop after ``until`` seconds if given.

    Raises
    ------
    UsageError
        ``out`` holds a run of another network, size, seed or set of labels.
    KeyboardInterrupt
        On Ctrl-C or SIGTERM, when the run is saved.
    """
    run = RunFolder(out, _manifest(options, config, label_hashes or {}))
    if not run.finished(options.steps):
        with alone([run]), until_interrupted() as stop:
            _train(run, options, config, until, labels, stop)


def _train(
    run: RunFolder, options: PaperTraining, config: UNetConfig, until: float | None,
    labels: Sequence[LabelTree], stop: Flag,
) -> None:  # fmt: skip
    torch.manual_seed(options.seed)
    net = UNetPredictor(config).to(options.device)
    # The stubs do not know this keyword of a module.
    net = net.to(memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    optimiser = torch.optim.AdamW(
        net.parameters(), lr=options.learning_rate, weight_decay=options.weight_decay
    )
    step = run.resume(net, optimiser)
    skipped = int(run.manifest.get("skipped_steps", 0))
    drawn_once = functools.cache(
        lambda i: training_pictures(VALIDATION_SEED, i * POSES, config, usual=options.usual)
    )

    def save_and_score() -> None:
        due = step > 0 and (step % options.save_every == 0 or step == options.steps)
        if not due or run.scored(step):
            return
        run.save(net, optimiser, step, {"skipped_steps": skipped})
        # The flag ends the loop.
        with contextlib.suppress(KeyboardInterrupt):
            trees = heeding(stop, range(options.validation_trees))
            scores = validate(net, (p for i in trees for p in drawn_once(i)))
            error = float(np.mean([s["depth_error"] for s in scores.values()]))
            run.keep_best(step, error, scores)
            run.log(step, scores, scores)
            _tell(step, scores)

    forward = torch.compile(net) if options.compiled else net
    line = ProgressLine(step, options.steps, options.trees * VIEWS, "pictures")
    began = time.monotonic()
    # The run before may have ended while it was scored.
    save_and_score()
    while step < options.steps:
        if stop.is_set() or (until is not None and time.monotonic() - began > until):
            break
        drawn = [
            p
            for j in range(options.trees)
            for p in training_pictures(
                options.seed, step * options.trees + j, config, labels, options.usual
            )
        ]
        batch = Batch.of(drawn, config.alpha, options.device)
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(options, step)
        with precision(options.device, options.bf16):
            picture = batch.pictures.contiguous(memory_format=torch.channels_last)
            answer = forward(picture, batch.axes)
        loss, _ = batch_loss(answer.float(), batch, step, options)
        optimiser.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(net.parameters(), options.clip)
        if bool(torch.isfinite(norm)):
            optimiser.step()
        else:
            skipped += 1
        run.took(float(loss.detach()))
        step += 1
        line.show(step, run.losses)
        save_and_score()
    run.save(net, optimiser, step, {"skipped_steps": skipped})
    if step < options.steps or stop.is_set():
        run.interrupt(step)


def _manifest(
    options: PaperTraining, config: UNetConfig, label_hashes: Mapping[str, str]
) -> dict[str, Any]:
    return {
        "network": "unet",
        "config": dataclasses.asdict(config),
        "seed": options.seed,
        "options": dataclasses.asdict(options),
        "labels": dict(label_hashes),
        "data": "generated trees (gcar_export.scenes.trees): tree step * trees + j of the seed"
        if not label_hashes
        else "generated trees (gcar_export.scenes.trees) and label volumes",
        "validation_seed": VALIDATION_SEED,
    }


def _tell(step: int, scores: Mapping[str, Mapping[str, float]]) -> None:
    shown = "  ".join(
        f"{kind}: p {s['precision']:.3f} r {s['recall']:.3f} depth {s['depth_error']:.1f} px"
        for kind, s in scores.items()
    )
    click.echo(f"step {step}  {shown}", err=True)
