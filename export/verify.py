"""Verify a model file: its spec, and what it does through the runtime's own predictor."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gcar_deploy.geometry.grid import Grid
from gcar_deploy.predict.candidates import Candidates
from gcar_deploy.predict.center_predictor import CenterPredictor
from gcar_deploy.predict.model_spec import read_model
from gcar_export.dataset import training_scene

#: seed of the scenes; neither training nor validation draws from it
SEED = 80_001


def verify_model(path: Path, scenes: int) -> str:
    """Run ``scenes`` generated scenes and say how well their vessel is found.

    Raises
    ------
    ModelError
        The file is not what its spec says.
    """
    predictor = CenterPredictor(read_model(path))
    dice: dict[str, list[float]] = {}
    for i in range(scenes):
        scene = training_scene(SEED, i)
        points = scene.points_mm
        n = 128
        lattice = Grid(center_mm=(0, 0, 0), size_mm=(n * scene.spacing_mm,) * 3, shape=(n, n, n))
        index = np.rint(lattice.world2index(points)).astype(np.int64)
        found = predictor.predict(Candidates(index, points, lattice), scene.encoded)
        chosen, truth = found.confidence >= 0.5, scene.occupancy >= 0.5
        score = 2 * (chosen & truth).sum() / max(int(chosen.sum() + truth.sum()), 1)
        dice.setdefault(scene.kind, []).append(float(score))
    lines = [f"{path.name}: SHA-256 {predictor.model.sha256[:16]}..., as its spec says"]
    worst = predictor.check_golden()
    lines.append(
        "  no golden case beside it"
        if worst is None
        else f"  golden case: largest difference {worst:.1e}"
    )
    lines += [
        f"  {kind}: Dice at 0.5 on the hull {np.mean(v):.3f} ({len(v)} scenes)"
        for kind, v in sorted(dice.items())
    ]
    return "\n".join(lines)
