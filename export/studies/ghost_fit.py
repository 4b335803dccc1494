"""Fit ``gcar_deploy/quality/ghosts.json``: the probability that a stretch of a tree is a ghost.

Logistic regression of the share of a stretch that lies further than ``GHOST_MM`` from the true
tree, on the figures of ``quality.ghost_figures``, each stretch weighed by its length: pairs of
pictures of one generated tree of each kind that ``gate_pairs`` makes. What is stated is then
compared with what came true on generated trees of another seed and on real ones, of which nothing
is fitted: a reliability table and picture, and the calibration slope and intercept (Cox 1958).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit

from gcar_deploy.files import whole_file
from gcar_deploy.quality import FIGURES, GHOST_MM, GhostModel
from gcar_deploy.types import Array, Scalars
from gcar_export.studies.gate_pairs import PICTURES
from gcar_export.studies.gate_rows import Row

#: pull of each weight towards 0, observations
PULL = 1.0
#: length that counts as one observation, mm: whole trees share their fate more than stretches do.
#: Of 8 to 1000 mm this states best what trees that are left out of the fit turn out to be
OBSERVED_MM = 400.0
#: edges of the classes of the reliability table
CLASSES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0)


def stretches(rows: Sequence[Row]) -> tuple[Array, Scalars, Scalars]:
    """Return (k, figures), (k,) shares that are off and (k,) lengths, mm, of pairs of one tree."""
    own = [row.whole for row in rows if row.kind == "same" and row.whole.figures]
    figures = [np.array(attempt.figures) for attempt in own]
    return (
        np.concatenate(figures or [np.zeros((0, len(FIGURES)))]),
        np.concatenate([np.zeros(0), *(attempt.off for attempt in own)]),
        np.concatenate([np.zeros(0), *(attempt.length_mm for attempt in own)]),
    )


def fit(rows: Sequence[Row]) -> GhostModel:
    """Maximise the penalised likelihood."""
    figures, off, length = stretches(rows)
    mean = np.average(figures, axis=0, weights=length)
    sd = np.sqrt(np.average((figures - mean) ** 2, axis=0, weights=length))
    sd = np.where(sd > 1e-9, sd, 1.0)
    usual = GhostModel(mean, sd, np.zeros(len(mean)), 0.0)
    told = np.column_stack([usual.standardised(figures), np.ones(len(figures))])
    weight = length / OBSERVED_MM

    def loss(x: Array) -> tuple[float, Array]:
        odds = told @ x
        value = weight @ (np.logaddexp(0.0, odds) - off * odds) + 0.5 * PULL * x[:-1] @ x[:-1]
        slope = told.T @ (weight * (expit(odds) - off))
        slope[:-1] += PULL * x[:-1]
        return float(value), slope

    x = minimize(loss, np.zeros(told.shape[1]), jac=True, method="L-BFGS-B").x
    return GhostModel(mean, sd, x[:-1], float(x[-1]))


def as_json(model: GhostModel, made_of: str) -> str:
    """Text of ``ghosts.json``."""
    figures = [
        {"name": name, "mean": round(float(m), 5), "sd": round(float(s), 5),
         "weight": round(float(w), 5)}
        for name, m, s, w in zip(FIGURES, model.mean, model.sd, model.weight, strict=True)
    ]  # fmt: skip
    held = {"made_of": made_of, "bias": round(model.bias, 5), "figures": figures}
    return json.dumps(held, indent=1) + "\n"


def made_of(rows: Sequence[Row], seed: int, predictor: str) -> str:
    """Say what a fit rests on."""
    own = [row for row in rows if row.kind == "same" and row.whole.figures]
    kinds = ", ".join(f"{sum(r.pictures == p for r in own)} {p}" for p in PICTURES)
    length = stretches(own)[2].sum()
    return (
        f"gcar-export ghost-fit, generated trees of seed {seed}: pairs of pictures {kinds}; "
        f"{length / 1000:.1f} m of vessel, a ghost further than {GHOST_MM:g} mm from any; "
        f"predictor {predictor}"
    )


def reliability(model: GhostModel, rows: Sequence[Row]) -> list[tuple[float, float, float]]:
    """Return per class of ``CLASSES`` the length, mm, the mean stated, and the share come true."""
    figures, off, length = stretches(rows)
    told = model.probability(figures)
    which = np.clip(np.searchsorted(CLASSES, told, side="right") - 1, 0, len(CLASSES) - 2)
    out = []
    for k in range(len(CLASSES) - 1):
        own = which == k
        total = float(length[own].sum())
        if total > 0:
            stated, true = (np.average(v[own], weights=length[own]) for v in (told, off))
            out.append((total, float(stated), float(true)))
        else:
            out.append((0.0, float("nan"), float("nan")))
    return out


def calibration(model: GhostModel, rows: Sequence[Row]) -> tuple[float, float]:
    """Slope and intercept of the true log odds on those stated: 1 and 0 where all is well."""
    figures, off, length = stretches(rows)
    odds = logit(np.clip(model.probability(figures), 1e-6, 1 - 1e-6))

    def loss(x: Array) -> float:
        z = x[0] * odds + x[1]
        return float(length @ (np.logaddexp(0.0, z) - off * z))

    slope, intercept = minimize(loss, np.array([1.0, 0.0]), method="Nelder-Mead").x
    return float(slope), float(intercept)


def discrimination(model: GhostModel, rows: Sequence[Row]) -> float:
    """Area under the ROC of stretches that are ghosts to more than half, by their length."""
    figures, off, length = stretches(rows)
    order = np.argsort(-model.probability(figures), kind="stable")
    ghost, weight = off[order] > 0.5, length[order]
    hits, alarms = np.cumsum(weight * ghost), np.cumsum(weight * ~ghost)
    return float(np.trapezoid(hits / hits[-1], alarms / alarms[-1]))


def summary_table(model: GhostModel, groups: Mapping[str, Sequence[Row]]) -> str:
    """Markdown: how the model does on each group and on each kind of its pictures."""
    out = [
        "| trees | pictures | pairs | m of vessel | ghosts % | expected % | area under ROC "
        "| slope | intercept |",
        "|---" * 9 + "|",
    ]
    for name, rows in groups.items():
        for pictures in ("all", *PICTURES):
            own = [r for r in rows if pictures in ("all", r.pictures) and r.kind == "same"]
            figures, off, length = stretches(own)
            if not len(off):
                continue
            told = model.probability(figures)
            few = not 0 < (off > 0.5).sum() < len(off)
            cells = [
                name, pictures, str(sum(bool(r.whole.figures) for r in own)),
                f"{length.sum() / 1000:.1f}", f"{100 * np.average(off, weights=length):.1f}",
                f"{100 * np.average(told, weights=length):.1f}",
                "-" if few else f"{discrimination(model, own):.3f}",
                *("-" if few else f"{v:.2f}" for v in calibration(model, own)),
            ]  # fmt: skip
            out.append("| " + " | ".join(cells) + " |")
    return "\n".join(out)


def reliability_table(model: GhostModel, groups: Mapping[str, Sequence[Row]]) -> str:
    """Markdown: what is stated and what came true, per class of the stated probability."""
    out = [
        "| stated % | " + " | ".join(f"{name}: mm, stated %, true %" for name in groups) + " |",
        "|---" * (1 + len(groups)) + "|",
    ]
    found = [reliability(model, rows) for rows in groups.values()]
    for k in range(len(CLASSES) - 1):
        cells = [f"{100 * CLASSES[k]:.0f} .. {100 * CLASSES[k + 1]:.0f}"]
        for table in found:
            total, stated, true = table[k]
            cells.append(f"{total:.0f}, {100 * stated:.1f}, {100 * true:.1f}" if total else "-")
        out.append("| " + " | ".join(cells) + " |")
    return "\n".join(out)


def draw(model: GhostModel, groups: Mapping[str, Sequence[Row]], file: Path) -> None:
    """Draw the reliability diagram: true against stated share, areas by length of vessel."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    panel = figure.add_subplot()
    panel.plot([0, 100], [0, 100], "k--", linewidth=0.8)
    # Okabe and Ito's colours, which all eyes tell apart, and a mark of its own for each group.
    looks = (("#0072B2", "o"), ("#E69F00", "s"), ("#009E73", "^"))
    for (name, rows), (colour, mark) in zip(groups.items(), looks, strict=False):
        found = [row for row in reliability(model, rows) if row[0] > 0]
        size = [8 + 120 * np.sqrt(total / sum(row[0] for row in found)) for total, _, _ in found]
        stated, true = [100 * row[1] for row in found], [100 * row[2] for row in found]
        panel.plot(stated, true, color=colour, linewidth=0.8)
        panel.scatter(stated, true, s=size, color=colour, marker=mark, label=name, alpha=0.8)
    panel.set(xlabel="stated probability of a ghost, %", ylabel="vessel that is a ghost, %",
              xlim=(-2, 102), ylim=(-2, 102))  # fmt: skip
    panel.legend(fontsize=8)
    with whole_file(file) as partial:
        figure.savefig(partial, dpi=110, format="png")
