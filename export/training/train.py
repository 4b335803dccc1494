"""Start a training by name: which network, which preset, which of users' own label volumes."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from gcar_deploy.errors import UsageError
from gcar_export.scenes.capsules import LabelTree

NETWORKS = ("multi", "paper")


def start(
    out: Path,
    network: str,
    preset: str,
    *,
    steps: int | None = None,
    decay_steps: int | None = None,
    learning_rate: float | None = None,
    seed: int | None = None,
    minutes: float | None = None,
    labels: Path | None = None,
    warm_start: Path | None = None,
) -> None:
    """Train ``network`` with a preset, some of its numbers replaced.

    Parameters
    ----------
    out : folder of the run; a run that is there goes on
    network : ``multi`` or ``paper``
    preset : ``cpu``, ``gpu``, ``tune`` (multi alone) or ``tiny``
    steps, decay_steps, learning_rate, seed : replace the preset's
    minutes : stop after so long
    labels : folder of label volumes (NIfTI, NRRD, MetaImage) that half of the scenes show
    warm_start : model (.onnx) whose weights are the first, multi alone

    Raises
    ------
    UsageError
        No CUDA device for ``gpu``; unreadable labels; ``out`` holds another run; a preset or a
        warm start that the network does not have.
    """
    from gcar_export.training import multi as train_multi
    from gcar_export.training import paper as train_paper
    from gcar_export.training.run_folder import check_device

    if network not in NETWORKS:
        raise UsageError(f"network {network!r} is none of {', '.join(NETWORKS)}")
    if network == "paper" and (preset == "tune" or warm_start is not None):
        raise UsageError("network paper starts from random weights: no preset tune, no warm start")
    trees: list[LabelTree] = []
    hashes: dict[str, str] = {}
    if labels is not None:
        from gcar_export.scenes.label_trees import read_label_trees

        trees, hashes = read_label_trees(labels)
    asked = {
        "steps": steps, "decay_steps": decay_steps, "learning_rate": learning_rate, "seed": seed,
    }  # fmt: skip
    changes: dict[str, Any] = {k: v for k, v in asked.items() if v}
    until = None if minutes is None else minutes * 60
    if network == "multi":
        options = dataclasses.replace(train_multi.PRESETS[preset], **changes)
        check_device(options.device)
        train_multi.train(
            out, options, train_multi.CONFIGS[preset], until=until, labels=trees,
            label_hashes=hashes, warm_start=warm_start,
        )  # fmt: skip
    else:
        single = dataclasses.replace(train_paper.PRESETS[preset], **changes)
        check_device(single.device)
        train_paper.train(
            out, single, train_paper.CONFIGS[preset], until=until, labels=trees,
            label_hashes=hashes,
        )  # fmt: skip
