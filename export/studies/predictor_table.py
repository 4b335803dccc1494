"""Multi-view predictors side by side: every kind of input, every size of cell.

    python -m gcar_export.studies.predictor_table MODEL.onnx [MODEL.onnx ...] --scenes 8

Scenes are generated and held out. ``network``: hull points with a confidence of 0.5 and more;
``decided``: after the runtime's decision. Precision is the share of them within 1.5 cells of a
vessel's cell, recall that of the centreline within 1.5 cells of one of them.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.models.spec import read_model
from gcar_deploy.predict.center_predictor import CenterPredictor, open_predictor
from gcar_deploy.predict.decision import decide
from gcar_deploy.predict.kinds import MULTI
from gcar_deploy.types import Array
from gcar_export.scenes.pictures import PATH_ERRORS
from gcar_export.studies.command import ended
from gcar_export.training.dataset import TrainingScene, training_scene
from gcar_export.training.examinations import REGIMES, SceneOptions

#: seed of the scenes; neither training, validation nor the task check draws from it
SEED = 80_101
#: lower ends of the ranges of cells, mm
CELLS_MM = (0.3, 0.5, 0.85, 1.25)
REACH_CELLS = 1.5


@dataclasses.dataclass(frozen=True)
class Row:
    """What one model makes of one scene: (Dice, precision, recall) before and after deciding."""

    model: str
    kind: str
    cell_mm: float
    network: tuple[float, float, float]
    decided: tuple[float, float, float]


def scenes(each: int) -> Iterator[TrainingScene]:
    """Yield so many scenes of every regime and kind of input."""
    for r, regime in enumerate(REGIMES):
        shares = {"paper_share": float(regime == "paper"), "fine_share": float(regime == "fine")}
        for k in range(len(PATH_ERRORS)):
            one = tuple(float(j == k) for j in range(len(PATH_ERRORS)))
            options = SceneOptions(inputs=one, **shares)  # type: ignore[arg-type]
            for i in range(each):
                yield training_scene(SEED + 10 * r + k, i, options)


def scores(confidence: Array, scene: TrainingScene) -> tuple[float, float, float]:
    """Dice on the hull, precision and recall of the points at 0.5 and more."""
    chosen, truth = confidence >= 0.5, scene.occupancy >= 0.5
    dice = 2 * (chosen & truth).sum() / max(int(chosen.sum() + truth.sum()), 1)
    if not chosen.any():
        return float(dice), float("nan"), 0.0
    reach = REACH_CELLS * scene.spacing_mm
    points = scene.points_mm[chosen]
    precision = (cKDTree(scene.points_mm[truth]).query(points)[0] <= reach).mean()
    recall = (cKDTree(points).query(scene.line_mm)[0] <= reach).mean()
    return float(dice), float(precision), float(recall)


def measured(name: str, predictor: CenterPredictor, scene: TrainingScene) -> Row:
    """Run one model on one scene."""
    found = predictor.predict(scene.hull, scene.encoded)
    decided = decide(found, scene.encoded, scene.path_error)
    return Row(
        name,
        scene.kind.split("-")[1],
        scene.spacing_mm,
        scores(found.confidence, scene),
        scores(decided.confidence, scene),
    )


def table(rows: Sequence[Row]) -> str:
    """Markdown: one line per range of cells and kind of input, one group of columns per model."""
    names = list(dict.fromkeys(row.model for row in rows))
    out = ["| cells, mm | input | scenes |" + "".join(f" {n} network | decided |" for n in names)]
    out.append("|---|---|---|" + "---|---|" * len(names))
    ends = (*CELLS_MM[1:], np.inf)
    for low, high in zip(CELLS_MM, ends, strict=True):
        for kind in PATH_ERRORS:
            own = [r for r in rows if r.kind == kind and low <= r.cell_mm < high]
            if own:
                out.append(_line(f"{low:g} .. {high:g} | {kind}", own, names))
    out.append(_line("all | all", rows, names))
    return "\n".join(out)


def _line(title: str, rows: Sequence[Row], names: Sequence[str]) -> str:
    cells = []
    for name in names:
        own = [r for r in rows if r.model == name]
        for what in ([r.network for r in own], [r.decided for r in own]):
            dice, precision, recall = np.nanmean(what, axis=0)
            cells.append(f" {dice:.3f} ({precision:.2f} / {recall:.2f}) |")
    return f"| {title} | {len(rows) // len(names)} |" + "".join(cells)


def main() -> None:
    """Print the table: Dice (precision / recall)."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--scenes", type=int, default=8, help="per regime and kind of input")
    asked = parser.parse_args()
    opened = {}
    for path in asked.models:
        predictor = open_predictor(read_model(path, (MULTI,)), threads=1)
        if not isinstance(predictor, CenterPredictor):
            parser.error(f"{path}: not a multi-view predictor")
        opened[str(path.with_suffix(""))] = predictor
    rows = [measured(n, p, s) for s in scenes(asked.scenes) for n, p in opened.items()]
    print(table(rows))


if __name__ == "__main__":
    raise SystemExit(ended(main))
