"""Proof that an ONNX file says what its checkpoint says, on ordinary and on extreme inputs."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from gcar_deploy.errors import ModelError
from gcar_deploy.predict.encoding import Encoded, flat_inputs
from gcar_deploy.predict.kinds import read_predictor
from gcar_deploy.types import Array
from gcar_export.shipping.export_onnx import (
    DeployedSparse,
    deployed,
    export_model,
    finish,
    graph_inputs,
)
from gcar_export.shipping.golden import write_golden
from gcar_export.shipping.task_check import task_measure, torch_predictor
from gcar_export.training.dataset import training_scene
from gcar_export.training.networks.unet import UNetConfig, UNetPredictor
from gcar_export.training.paper_dataset import training_pictures

#: largest difference between torch and ONNX Runtime, as a share of the output's range
PARITY = 1e-4
#: share of decisions that must be the same
DECISIONS = 0.9999
#: how far the task measure may differ between torch and the runtime's own predictor
TASK = 1e-3
#: seed of the inputs; neither training nor validation draws from it
SEED = 70_001


@dataclasses.dataclass(frozen=True)
class Parity:
    """Largest difference between torch and ONNX Runtime over some inputs.

    Attributes
    ----------
    inputs : how many were compared
    worst : largest difference, as a share of the output's range
    decisions_equal : share of confidences (multi) or cells' nearest pixels of depth (single)
        that fall on the same side
    task_torch, task_runtime : the task measure of both, or NaN where it was not asked for
    """

    inputs: int
    worst: float
    decisions_equal: float
    task_torch: float = float("nan")
    task_runtime: float = float("nan")


def parity(checkpoint: Path, model: Path, inputs: int) -> Parity:
    """Compare both on so many inputs, extremes among them."""
    import onnxruntime as ort

    net = deployed(checkpoint)
    session = ort.InferenceSession(model.read_bytes(), providers=["CPUExecutionProvider"])
    worst, equal, count, total = 0.0, 0, 0, 0
    for arrays in _inputs(net, inputs):
        with torch.no_grad():
            a = net(*[torch.from_numpy(x) for x in arrays]).numpy()
        b = session.run(None, dict(zip(graph_inputs(net), arrays, strict=True)))[0]
        off = float(np.abs(a - b).max() / max(float(np.ptp(a)), 1.0))
        worst = off if not np.isfinite(off) else max(worst, off)
        first, second = (x[:, 0] for x in (a, b))
        equal += int(((first >= 0.5) == (second >= 0.5)).sum())
        total += first.size
        count += 1
    return Parity(count, worst, equal / max(total, 1))


def _inputs(net: DeployedSparse | UNetPredictor, count: int) -> Iterator[list[Array]]:
    """Extreme inputs first, then generated ones."""
    if isinstance(net, DeployedSparse):
        scene = training_scene(SEED, 0).encoded
        extremes = [
            dataclasses.replace(scene, features=np.zeros_like(scene.features)),
            dataclasses.replace(scene, features=np.full_like(scene.features, 16.0)),
            dataclasses.replace(scene, ray_path=np.zeros_like(scene.ray_path)),
            _one_point(scene),
        ]
        yield from (flat_inputs(e) for e in extremes[:count])
        for i in range(count - len(extremes)):
            yield flat_inputs(training_scene(SEED, i).encoded)
        return
    for picture, axes in _pictures(net.config, count):
        yield [picture, axes][: len(graph_inputs(net))]


def _pictures(config: UNetConfig, count: int) -> Iterator[tuple[Array, Array]]:
    """Nothing, all, one pixel, a batch of these, then generated pictures; each with its axes."""
    n = config.pixels
    drawn = (p.picture for i in range(count) for p in training_pictures(SEED, i, config))
    first = next(drawn)
    single = np.zeros((1, 1, n, n), np.float32)
    single[0, 0, n // 2, n // 3] = 1
    extremes = [np.zeros_like(single), np.ones_like(single), single]
    axes = first.axes_input()
    yield from ((e, axes) for e in extremes[:count])
    if count > 3:
        batch = [*extremes, first.network_input()]
        yield np.concatenate(batch), np.concatenate([axes] * len(batch))
    for _, picture in zip(range(count - 4), drawn, strict=False):
        yield picture.network_input(), picture.axes_input()


def _one_point(scene: Encoded) -> Encoded:
    """Cut a scene down to its first point."""
    none = np.full((1, 27), 1, np.int64)
    none[0, 13] = 0
    alone = tuple(none for _ in scene.neighbours)
    child = np.full((1, 8), 1, np.int64)
    child[0, 0] = 0
    zero = np.zeros(1, np.int64)
    views = len(scene.ray)
    return Encoded(
        features=scene.features[:, :1].copy(),
        ray=np.zeros((views, 1), np.int64),
        ray_path=scene.ray_path[:, :1].copy(),
        weight=scene.weight[:, :1].copy(),
        neighbours=alone,
        parent=tuple(zero for _ in scene.parent),
        members=np.zeros((views, 1, 1), np.int64),
        children=tuple(child for _ in scene.children),
    )


def export_checked(checkpoint: Path, out: Path, inputs: int = 60, task_scenes: int = 4) -> Parity:
    """Export, compare on ``inputs`` inputs and on the task, and refuse what differs.

    Raises
    ------
    ModelError
        The ONNX file says something else than the checkpoint; the file is taken away.
    """
    if out.suffix != ".onnx":
        raise ModelError(f"{out.name}: the file to write must end in .onnx")
    partial = out.with_name(f"{out.stem}.partial.onnx")
    new = not out.parent.exists()
    try:
        export_model(checkpoint, partial)
        found = parity(checkpoint, partial, inputs)
        if task_scenes:
            found = dataclasses.replace(
                found,
                task_torch=task_measure(torch_predictor(checkpoint, partial), task_scenes),
                task_runtime=task_measure(read_predictor(partial), task_scenes),
            )
        accept(out.name, found)
        spec = read_predictor(partial).spec
        os.replace(partial, out)
        finish(out, {**spec, "name": out.stem})
        write_golden(out, force=True)
    finally:
        for path in (partial, partial.with_suffix(".json")):
            path.unlink(missing_ok=True)
        if new and out.parent.is_dir() and not any(out.parent.iterdir()):
            out.parent.rmdir()
    return found


def accept(name: str, found: Parity) -> None:
    """Raise ModelError unless the comparison shows one and the same network."""
    # Not "worse than": a comparison with NaN is false.
    failed = []
    if not found.worst <= PARITY:
        failed.append(f"by {found.worst:.1e} of the range (at most {PARITY:g})")
    if not found.decisions_equal >= DECISIONS:
        equal = f"{found.decisions_equal:.4%} of them are equal"
        failed.append(f"in its decisions: {equal} (at least {DECISIONS:.2%})")
    if failed:
        raise ModelError(f"{name} differs from its checkpoint {' and '.join(failed)}")
    if abs(found.task_torch - found.task_runtime) > TASK:
        raise ModelError(
            f"{name} reaches {found.task_runtime:.4f} through the runtime's own predictor, its "
            f"checkpoint {found.task_torch:.4f}: more than {TASK:g} apart"
        )
