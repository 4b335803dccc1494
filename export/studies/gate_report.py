"""Tables and a picture of what the gates do with pairs of known kind; see ``gate_table``."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gcar_deploy.config import QualityOptions
from gcar_deploy.files import whole_file
from gcar_deploy.quality import check_order, disagreement_limits
from gcar_deploy.quality.status import DEGRADED, OK, REFUSED
from gcar_export.studies.gate_pairs import KINDS, PICTURES, UNITS, WRONG
from gcar_export.studies.gate_rows import Row
from gcar_export.studies.gate_table import GATES, choose, cost, kind_of_row, replayed, with_gate

_STATUSES = (OK, DEGRADED, REFUSED)


def status_table(rows: Sequence[Row], gates: QualityOptions) -> str:
    """Markdown: what becomes of each kind of pair, with the figures that decide."""
    out = [
        "| pictures | pair | n | ok / degraded / refused | told that pictures may be swapped "
        "| disagreement % (least, 10, 50, 90 % of pairs, most) | other order, ratio "
        "| least coverage % | least support % "
        "| ok: DSC % | ok: shape mm | degraded: DSC % |",
        "|---" * 12 + "|",
    ]
    for pictures in PICTURES:
        for kind in KINDS:
            own = [r for r in rows if (r.pictures, r.kind) == (pictures, kind)]
            if own:
                out.append(_status_line(own, pictures, kind, gates))
    return "\n".join(out)


def _status_line(own: Sequence[Row], pictures: str, kind: str, gates: QualityOptions) -> str:
    by: dict[str, list[Row]] = {status: [] for status in _STATUSES}
    for row in own:
        by[replayed(row, gates)].append(row)
    told = sum(bool(_hint(row, gates)) for row in own)
    ratios = [r.other_order / max(r.whole.disagreement, 1e-9) for r in own if r.other_order]
    covered = [min(c or 0.0 for c in r.whole.coverage) for r in own if r.whole.coverage]
    seen = [min(c or 0.0 for c in r.whole.support) for r in own if r.whole.support]
    ok, degraded = by[OK], by[DEGRADED]
    cells = [
        pictures, kind, str(len(own)), " / ".join(str(len(by[s])) for s in _STATUSES), str(told),
        _spread([r.whole.disagreement for r in own], 100), _spread(ratios, 1),
        _spread(covered, 100), _spread(seen, 100), _mean([r.whole.dsc for r in ok], 100),
        _mean([r.whole.shape_mm for r in ok], 1), _mean([r.whole.dsc for r in degraded], 100),
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def _hint(row: Row, gates: QualityOptions) -> str:
    disagreement = row.whole.disagreement
    return check_order(("1", "2"), disagreement, row.other_order, kind_of_row(row), gates)[1]


def level_table(rows: Sequence[Row], gates: QualityOptions) -> str:
    """Markdown: raw pairs of one tree by what their pictures are made of."""
    out = [
        "| raw pictures of one tree | n | ok / degraded / refused "
        "| disagreement % (least, 10, 50, 90 % of pairs, most) | DSC %, gates open |",
        "|---" * 5 + "|",
    ]
    own = [r for r in rows if r.pictures == "raw" and r.kind == "same"]
    for field in ("contrast", "background", "photons"):
        for level in sorted({getattr(r, field) for r in own}):
            part = [r for r in own if getattr(r, field) == level]
            found = [replayed(r, gates) for r in part]
            cells = [
                f"{field} {level:g}{UNITS[field]}", str(len(part)),
                " / ".join(str(found.count(s)) for s in _STATUSES),
                _spread([r.whole.disagreement for r in part], 100),
                _mean([r.whole.dsc for r in part], 100),
            ]  # fmt: skip
            out.append("| " + " | ".join(cells) + " |")
    return "\n".join(out)


def doubt_table(rows: Sequence[Row], gates: QualityOptions) -> str:
    """Markdown: what the finished tree says of raw pairs that disagree much, but are not refused.

    And how many pairs would be ``ok`` if nobody asked for the other order of the pictures.
    """
    out = [
        "| raw pictures | n | in doubt | of these, a view less explained than the gate "
        "| ok | ok, other order not asked |",
        "|---" * 6 + "|",
    ]
    unasked = dataclasses.replace(gates, order_ratio=0.0, swapped_ratio=0.0)
    raw = [r for r in rows if r.pictures == "raw"]
    groups = {
        "one tree, comes out": [r for r in raw if r.kind == "same" and r.came_out],
        "one tree, does not": [r for r in raw if r.kind == "same" and not r.came_out],
        **{kind: [r for r in raw if r.kind == kind] for kind in WRONG},
    }
    for name, part in groups.items():
        doubted = [
            r for r in part
            if gates.good_disagreement_raw < r.whole.disagreement <= gates.max_disagreement_raw
        ]  # fmt: skip
        short = [
            r for r in doubted if min([c or 0.0 for c in r.whole.coverage_even] or [0.0])
            < gates.good_coverage
        ]  # fmt: skip
        oks = [sum(replayed(r, g) == OK for r in part) for g in (gates, unasked)]
        cells = [name, *map(str, (len(part), len(doubted), len(short), *oks))]
        out.append("| " + " | ".join(cells) + " |")
    return "\n".join(out)


def gate_table(chosen_on: Sequence[Row], checked_on: Sequence[Row], gates: QualityOptions) -> str:
    """Markdown: present gates, what the first rows choose, and what that costs both."""
    chosen = choose(chosen_on, gates)
    out = ["| gate | present | chosen | cheapest alone, on the first seed |", "|---|---|---|---|"]
    for name, values in GATES.items():
        costs = [cost(chosen_on, with_gate(gates, name, value)) for value in values]
        best = [value for value, c in zip(values, costs, strict=True) if c < min(costs) + 1e-9]
        out.append(
            f"| `{name}` | {getattr(gates, name):g} | {getattr(chosen, name):g} "
            f"| {best[0]:g} .. {best[-1]:g} ({min(costs):.3f}) |"
        )
    for name, rows in (("the first seed", chosen_on), ("the second seed", checked_on)):
        out.append(f"| cost, {name} | {cost(rows, gates):.3f} | {cost(rows, chosen):.3f} | |")
    return "\n".join(out)


def _spread(values: Sequence[float], scale: float) -> str:
    if not values:
        return "-"
    found = scale * np.percentile(values, [0, 10, 50, 90, 100])
    return ", ".join(f"{value:.3g}" for value in found)


def _mean(values: Sequence[float | None], scale: float) -> str:
    known = [scale * value for value in values if value is not None]
    if not known:
        return "-"
    worst = f"least {min(known):.1f}" if scale > 1 else f"most {max(known):.2f}"
    return f"{np.mean(known):.{1 if scale > 1 else 2}f} ({worst})"


def draw(rows: Sequence[Row], gates: QualityOptions, file: Path) -> None:
    """Draw both distributions of the disagreement, and pairs with their pictures exchanged."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * len(PICTURES), 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    for k, pictures in enumerate(PICTURES):
        own = [r for r in rows if r.pictures == pictures]
        if not own:
            continue
        good, most = disagreement_limits(kind_of_row(own[0]), gates)
        _histogram(figure.add_subplot(2, len(PICTURES), 1 + k), own, pictures, (good, most))
        panel = figure.add_subplot(2, len(PICTURES), 1 + len(PICTURES) + k)
        for kind, colour in (("same", "C0"), ("two trees", "0.6"), ("swapped", "C3")):
            part = [r for r in own if r.kind == kind and r.other_order is not None]
            panel.plot(
                [100 * r.whole.disagreement for r in part],
                [100 * (r.other_order or 0.0) for r in part],
                ".", color=colour, label=kind,
            )  # fmt: skip
        edge = np.array([0.1, 100.0])
        panel.plot(edge, gates.order_ratio * edge, "k--", linewidth=0.8)
        panel.plot(edge, gates.swapped_ratio * edge, "k:", linewidth=0.8)
        panel.set(xscale="log", yscale="log", xlabel="disagreement as given, %",
                  ylabel="pictures exchanged, %")  # fmt: skip
        panel.legend(fontsize=7)
    with whole_file(file) as partial:
        figure.savefig(partial, dpi=110, format="png")


def _histogram(panel: Any, rows: Sequence[Row], pictures: str, gates: tuple[float, float]) -> None:
    bins = np.geomspace(0.05, 100, 40)
    for label, kinds, colour in (("one tree", ("same",), "C0"), ("contradictory", WRONG, "C3")):
        values = [100 * r.whole.disagreement for r in rows if r.kind in kinds]
        weights = np.full(len(values), 100 / max(len(values), 1))
        panel.hist(values, bins, weights=weights, alpha=0.55, color=colour, label=label)
    for gate, style in zip(gates, ("--", "-"), strict=True):
        panel.axvline(100 * gate, color="k", linestyle=style, linewidth=0.8)
    panel.set(xscale="log", xlabel="disagreement along the epipolar lines, %",
              ylabel="pairs, %", title=pictures)  # fmt: skip
    panel.legend(fontsize=7)
