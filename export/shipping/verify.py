"""Verify a model file: its spec, and what it does through the runtime's own predictor."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gcar_deploy.imaging.net import KIND as SEGMENTER
from gcar_deploy.imaging.net import Segmenter, open_segmenter
from gcar_deploy.models import model_card, read_model
from gcar_deploy.predict.center_predictor import open_predictor
from gcar_deploy.predict.kinds import PAPER, PREDICTOR_KINDS
from gcar_export.scenes.angiograms import training_pair
from gcar_export.shipping.task_check import REACH_PIXELS, scores
from gcar_export.training.terms import license_text

#: seed of the pictures that a segmenter is asked for; no training or validation draws from it
PICTURE_SEED = 80_002


def verify_model(path: Path, scenes: int) -> str:
    """Run ``scenes`` generated scenes and say how well their vessel is found; see ``task_check``.

    A segmenter is asked for as many generated angiograms.

    Raises
    ------
    ModelError
        The file is not what its spec says.
    """
    model = read_model(path, (*PREDICTOR_KINDS.values(), SEGMENTER))
    license_text(model.name, model.spec, "")
    found: dict[str, list[float]] = {}
    named = "Dice at 0.5 on the hull"
    if model.kind == SEGMENTER.name:
        named = "Dice at 0.5"
        segmenter = open_segmenter(path, threads=1)
        session = segmenter.session
        found["angiograms"] = list(_dice(segmenter, scenes))
    else:
        session = open_predictor(model, threads=1).session
        if model.kind == PAPER.name:
            named = f"share of lone centres within {REACH_PIXELS:g} pixels"
        for kind, score in scores(model, scenes):
            found.setdefault(kind, []).append(score)
    lines = model_card(model)
    worst = session.check_golden()
    lines.append(
        "warning: no golden case beside it: only its form was checked, not that it says what it "
        "said when it was made"
        if worst is None
        else f"golden case: largest difference {worst:.1e}"
    )
    lines.append("through the runtime's own predictor, on generated scenes:")
    lines += [
        f"  {kind}: {named} {np.mean(v):.3f} ({len(v)} scenes)" for kind, v in sorted(found.items())
    ]
    return "\n".join(lines)


def _dice(segmenter: Segmenter, pictures: int) -> Iterator[float]:
    """Dice at 0.5 of each picture, where its truth is sure."""
    for k in range(pictures):
        channels, truth = training_pair(PICTURE_SEED, k)
        asked = truth[1] > 0
        seen, true = ((m >= 0.5) & asked for m in (segmenter.look(channels).probability, truth[0]))
        yield 2 * float((seen & true).sum()) / max(float(seen.sum() + true.sum()), 1.0)
