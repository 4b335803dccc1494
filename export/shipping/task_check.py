"""What a predictor is for, as one number on generated scenes, through the runtime's own predictor.

Of the predictor of all views: mean Dice at 0.5 on the hull of two views, after the decision. Of the
paper's, which sees one: mean share of its centres within 1.5 pixels of the centreline.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from gcar_deploy.models import ModelFile
from gcar_deploy.predict.center_predictor import (
    CenterPredictor,
    Predictor,
    SingleViewPredictor,
    open_predictor,
)
from gcar_deploy.predict.decision import decide
from gcar_deploy.predict.kinds import MULTI, read_predictor
from gcar_deploy.types import Scalars
from gcar_export.shipping.export_onnx import DeployedSparse, deployed, graph_inputs
from gcar_export.training.dataset import TrainingScene, training_scene
from gcar_export.training.networks.unet import UNetConfig, UNetPredictor
from gcar_export.training.paper_dataset import training_pictures

#: seed of the scenes; neither training nor validation draws from it
SEED = 80_001
#: a predictor of all views with a lower Dice leaves no tree of most pictures
LEAST_DICE = 0.5
#: how near a centre of a single view must be, pixel edges
REACH_PIXELS = 1.5


def task_measure(model: ModelFile | Predictor, scenes: int) -> float:
    """Mean score over so many scenes."""
    return float(np.mean([score for _, score in scores(model, scenes)]))


def hardly_trained(model: Path, measured: float) -> bool:
    """Whether what was measured is too little; a single view's shares are low in any case."""
    return read_predictor(model).kind == MULTI.name and measured < LEAST_DICE


def scores(model: ModelFile | Predictor, scenes: int) -> list[tuple[str, float]]:
    """(kind of scene or view, score 0 .. 1) of each; see the module's head."""
    predictor = open_predictor(model, threads=1) if isinstance(model, ModelFile) else model
    if isinstance(predictor, SingleViewPredictor):
        return [score for i in range(scenes) for score in _near_shares(predictor, i)]
    out = []
    for i in range(scenes):
        scene = _scene(i)
        chosen, truth = confidences(predictor, scene) >= 0.5, scene.occupancy >= 0.5
        dice = 2 * (chosen & truth).sum() / max(int(chosen.sum() + truth.sum()), 1)
        out.append((scene.kind, float(dice)))
    return out


def confidences(predictor: CenterPredictor, scene: TrainingScene) -> Scalars:
    """(n,) what the runtime makes of a scene, as ``reconstruct`` does it."""
    found = predictor.predict(scene.hull, scene.encoded)
    return decide(found, scene.encoded, scene.path_error).confidence


def _near_shares(predictor: SingleViewPredictor, i: int) -> list[tuple[str, float]]:
    inputs = predictor.model.inputs
    config = UNetConfig(pixels=inputs["pixels"], alpha=inputs["alpha"])
    out = []
    for drawn in training_pictures(SEED, i, config, usual=not predictor.directions_deg):
        seen = drawn.picture
        (found,) = predictor.predict([(seen.carm, seen.path_mm)])
        off = cKDTree(drawn.centerline_mm).query(found.points_mm)[0]
        out.append((drawn.kind, float((off <= REACH_PIXELS * seen.pixel_mm).mean())))
    return out


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
