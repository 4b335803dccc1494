"""The verb that trains the network of catheters, leads and wires."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
_FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)


@click.command("train-devices")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the run.")
@click.option("--steps", type=click.IntRange(1), help="Steps in all.")
@click.option("--decay-steps", type=click.IntRange(1), help="Length of the final decay.")
@click.option("--batch", type=click.IntRange(1), help="Pictures of a step.")
@click.option("--learning-rate", type=float)
@click.option("--seed", type=int, help="Of the pictures.")
@click.option("--real", type=_FOLDER, help="Real angiograms to train on: N.png, N_gt.png.")
@click.option("--fold", metavar="K/N", help="Leave the K-th of N parts of them out.")
@click.option("--pictures", type=click.IntRange(1), help="That are drawn; each is used often.")
@click.option(
    "--pool", type=click.Path(path_type=Path), help="Folder that keeps them, for several runs."
)
@click.option("--warm-start", type=_FILE, help="ONNX model whose device network goes on.")
@click.option("--minutes", type=float, help="Stop after so long; the same command goes on.")
def train_devices(
    out: Path, pool: Path | None, warm_start: Path | None, minutes: float | None, **given: Any
) -> None:
    """Train the network that tells catheters, leads and wires along lines; stop and go on at will.

    It looks along the lines that the segmenter that comes along finds, which stays as it is.
    Without options: one CPU core for two hours, most of them to draw pictures; none are real.

    Example: gcar-export train-devices --out runs/d --real xca_masks --pictures 3400
    """
    from gcar_export.training import devices as training

    options = training.chosen({k: v for k, v in given.items() if v is not None})
    training.train(out, options, minutes=minutes, pool=pool, begin_from=warm_start)
