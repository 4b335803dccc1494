"""Verify a model file: its spec, and what it does through the runtime's own predictor."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gcar_deploy.predict.center_predictor import open_predictor
from gcar_deploy.predict.kinds import PAPER, read_predictor
from gcar_export.shipping.task_check import REACH_PIXELS, scores


def verify_model(path: Path, scenes: int) -> str:
    """Run ``scenes`` generated scenes and say how well their vessel is found; see ``task_check``.

    Raises
    ------
    ModelError
        The file is not what its spec says.
    """
    from gcar_deploy.cli.model_card import card

    model = read_predictor(path)
    found: dict[str, list[float]] = {}
    for kind, score in scores(model, scenes):
        found.setdefault(kind, []).append(score)
    named = (
        f"share of lone centres within {REACH_PIXELS:g} pixels"
        if model.kind == PAPER.name
        else "Dice at 0.5 on the hull"
    )
    lines = card(model)
    worst = open_predictor(model, threads=1).session.check_golden()
    lines.append(
        "no golden case beside it"
        if worst is None
        else f"golden case: largest difference {worst:.1e}"
    )
    lines.append("through the runtime's own predictor, on generated scenes:")
    lines += [
        f"  {kind}: {named} {np.mean(v):.3f} ({len(v)} scenes)" for kind, v in sorted(found.items())
    ]
    return "\n".join(lines)
