"""The verbs that train: a predictor, the segmenter, the network of catheters, leads and wires."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click

from gcar_export.cli.options import (
    COUNT,
    DURATION,
    FILE,
    FOLDER,
    OUT_FOLDER,
    RATE,
    SEED,
    Number,
    taking,
)

#: what the verbs ask that train on pictures
_on_pictures = taking(
    click.option("--out", type=OUT_FOLDER, required=True, help="Folder of the run."),
    click.option("--steps", type=COUNT, help="Steps in all."),
    click.option("--decay-steps", type=COUNT, help="Length of the final decay."),
    click.option("--batch", type=COUNT, help="Pictures of a step."),
    click.option("--learning-rate", type=RATE),
    click.option("--seed", type=SEED, help="Of the pictures, and of what is cut from them."),
    click.option("--real", type=FOLDER, help="Real angiograms to train on: N.png, N_gt.png."),
    click.option("--fold", metavar="K/N", help="Leave the K-th of N parts of them out."),
    click.option("--pictures", type=COUNT, help="Generated ones, drawn; each is used often."),
    click.option("--validation-pictures", type=COUNT, help="Held-out ones, that it is scored on."),
    click.option("--pool", type=OUT_FOLDER, help="Folder that keeps them, for several runs."),
    click.option("--minutes", type=DURATION, help="Stop after so long; the same command goes on."),
)


@click.command()
@click.option("--out", type=OUT_FOLDER, required=True, help="Folder of the run.")
@click.option(
    "--network",
    type=click.Choice(["multi", "paper"]),
    default="multi",
    show_default=True,
    help="The predictor that sees all views, or the paper's that sees one.",
)
@click.option(
    "--preset", type=click.Choice(["cpu", "gpu", "tune", "tiny"]), default="cpu", show_default=True
)
@click.option("--steps", type=COUNT, help="Steps in all; overrides the preset.")
@click.option("--decay-steps", type=COUNT, help="Length of the final linear decay.")
@click.option("--minutes", type=DURATION, help="Stop after so long; the same command goes on.")
@click.option(
    "--labels",
    type=FOLDER,
    help="Label volumes of your own (.nii, .nii.gz, .nrrd, .mha, .mhd): half of the scenes.",
)
@click.option("--learning-rate", type=RATE, help="The preset's otherwise.")
@click.option(
    "--seed", type=click.IntRange(1), help="Of the scenes; a tuning wants another than its model's."
)
@click.option("--warm-start", type=FILE, help="Go on from the weights of this model (.onnx).")
def train(
    out: Path,
    network: str,
    preset: str,
    steps: int | None,
    decay_steps: int | None,
    minutes: float | None,
    labels: Path | None,
    learning_rate: float | None,
    seed: int | None,
    warm_start: Path | None,
) -> None:
    """Train a predictor on generated trees; stop and go on at will.

    Example: gcar-export train --network paper --out runs/a --minutes 60
    """
    from gcar_export.training.train import start

    start(
        out, network, preset, steps=steps, decay_steps=decay_steps, minutes=minutes, labels=labels,
        learning_rate=learning_rate, seed=seed, warm_start=warm_start,
    )  # fmt: skip


@click.command("train-segmenter")
@click.option("--preset", type=click.Choice(["cpu", "gpu"]), default="cpu", show_default=True)
@_on_pictures
@click.option("--warmup-steps", type=COUNT, help="Length of the rise at the start.")
@click.option(
    "--folds", type=click.IntRange(2), help="Train as many beside it, each without one such part."
)
@click.option(
    "--real-share", type=Number(0, 1), help="Of the pictures of a step, where there are any."
)
@click.option("--warm-start", type=FILE, help="Checkpoint or ONNX model to begin with.")
def train_segmenter(
    out: Path, preset: str, warm_start: Path | None, pool: Path | None, minutes: float | None,
    **given: Any,
) -> None:  # fmt: skip
    """Train the segmentation network on generated and real angiograms; stop and go on at will.

    Options that are not given are those of the preset: two CPU cores for an hour, or a GPU.

    Example: gcar-export train-segmenter --out runs/s --real xca_masks --fold 1/5 --minutes 45
    """
    from gcar_export.training import segmenter as training

    options = training.chosen(preset, {k: v for k, v in given.items() if v is not None})
    workers = (os.cpu_count() or 1) if options.device != "cpu" else 1
    training.train(out, options, minutes=minutes, workers=workers, begin_from=warm_start, pool=pool)


@click.command("train-devices")
@_on_pictures
@click.option("--warm-start", type=FILE, help="ONNX model whose device network goes on.")
@click.option("--segmenter-model", type=FILE, help="ONNX segmenter of your own that finds lines.")
def train_devices(
    out: Path, pool: Path | None, warm_start: Path | None, segmenter_model: Path | None,
    minutes: float | None, **given: Any,
) -> None:  # fmt: skip
    """Train the network that tells catheters, leads and wires along lines; stop and go on at will.

    It looks along the lines that the segmenter finds, the one that comes along or your own, which
    stays as it is.
    Without options: one CPU core for two hours, most of them to draw pictures; none are real.

    Example: gcar-export train-devices --out runs/d --real xca_masks --pictures 3400
    """
    from gcar_export.training import devices as training

    options = training.chosen({k: v for k, v in given.items() if v is not None})
    training.train(
        out, options, minutes=minutes, pool=pool, begin_from=warm_start,
        segmenter_model=segmenter_model,
    )  # fmt: skip
