"""What a predictor is for, as one number: how well the hull's points are told apart.

Mean Dice at 0.5 on the hull of generated two-view scenes, through the runtime's own predictor,
encoding, merging and decision.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gcar_deploy.models import ModelFile
from gcar_deploy.predict.center_predictor import (
    Predictor,
    SingleViewPredictor,
    open_predictor,
)
from gcar_deploy.predict.decision import decide
from gcar_deploy.predict.kinds import read_predictor
from gcar_deploy.predict.single_view import merge_views
from gcar_deploy.types import Scalars
from gcar_export.shipping.export_onnx import DeployedSparse, deployed, graph_inputs
from gcar_export.training.dataset import TrainingScene, training_scene
from gcar_export.training.networks.unet import UNetPredictor

#: seed of the scenes; neither training nor validation draws from it
SEED = 80_001


def task_measure(model: ModelFile | Predictor, scenes: int) -> float:
    """Mean Dice over so many scenes."""
    return float(np.mean([dice for _, dice in scores(model, scenes)]))


def scores(model: ModelFile | Predictor, scenes: int) -> list[tuple[str, float]]:
    """(kind of scene, Dice at 0.5) of each scene."""
    predictor = open_predictor(model, threads=1) if isinstance(model, ModelFile) else model
    out = []
    for i in range(scenes):
        scene = _scene(i)
        chosen, truth = confidences(predictor, scene) >= 0.5, scene.occupancy >= 0.5
        dice = 2 * (chosen & truth).sum() / max(int(chosen.sum() + truth.sum()), 1)
        out.append((scene.kind, float(dice)))
    return out


def confidences(predictor: Predictor, scene: TrainingScene) -> Scalars:
    """(n,) what the runtime makes of a scene, as ``reconstruct`` does it."""
    if isinstance(predictor, SingleViewPredictor):
        seen = predictor.predict([(carm, path) for carm, path, _ in scene.views])
        merged = merge_views(seen, scene.hull, scene.encoded)
        return merged.confidence
    found = predictor.predict(scene.hull, scene.encoded)
    return decide(found, scene.encoded, scene.path_error).confidence


class _TorchSession:
    """Answers as an ONNX Runtime session would, with torch."""

    def __init__(self, net: DeployedSparse | UNetPredictor) -> None:
        self.net, self.names = net, graph_inputs(net)

    def run(self, _names: Any, feed: dict[str, Any], _options: Any = None) -> list[Any]:
        """Return the outputs as arrays."""
        with torch.no_grad():
            return [self.net(*[torch.from_numpy(feed[name]) for name in self.names]).numpy()]


def torch_predictor(checkpoint: Path, model: Path) -> Predictor:
    """Return the runtime's predictor with torch in place of ONNX Runtime."""
    file = dataclasses.replace(read_predictor(model), golden=None)
    return open_predictor(file, session=_TorchSession(deployed(checkpoint)))


@functools.lru_cache(maxsize=32)
def _scene(i: int) -> TrainingScene:
    return training_scene(SEED, i)
