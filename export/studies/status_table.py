"""Are statuses ordered by truth: what share of ``ok`` is bad, and how much bad is ``degraded``.

A pair is bad where its tree has a volume DSC under ``BAD_DSC``, or where the pictures contradict
each other (two trees, a wrong sign, swapped). The score underneath is the share of the tree's
length that is expected in ghosts; how well it tells bad pairs by itself is its ROC.

The rule for ``good_ghost_share``: the largest value at which less than ``MOST_BAD`` of the ``ok``
pairs of the first seed are bad, and the present one where there is none. What that costs is the
share of right pairs of path lengths that stay ``ok`` (``LEAST_OK`` is asked for).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gcar_deploy.config import QualityOptions
from gcar_deploy.files import whole_file
from gcar_deploy.quality.status import DEGRADED, OK, REFUSED
from gcar_deploy.types import Array
from gcar_export.studies.gate_pairs import PICTURES, WRONG
from gcar_export.studies.gate_rows import Row
from gcar_export.studies.gate_table import GATES, expected_ghosts, replayed, with_gate

#: a tree with less has not come out, as the status is meant
BAD_DSC = 0.7
#: largest share of bad pairs among ``ok``, and least of right pairs of path lengths that are ``ok``
MOST_BAD, LEAST_OK = 0.02, 0.85


def bad(row: Row) -> bool:
    """Whether a pair should not be ``ok``."""
    return row.kind in WRONG or (row.whole.dsc or 0.0) < BAD_DSC


def judged(rows: Sequence[Row]) -> list[Row]:
    """Return the pairs that count: of one tree or contradictory, not those off by a little."""
    return [row for row in rows if row.kind == "same" or row.kind in WRONG]


def chosen_share(rows: Sequence[Row], gates: QualityOptions) -> float:
    """Return ``good_ghost_share`` by the rule at the head of this file."""
    fit = gates.good_ghost_share
    for value in GATES["good_ghost_share"]:
        tried = with_gate(gates, "good_ghost_share", value)
        found = [bad(row) for row in judged(rows) if replayed(row, tried) == OK]
        if found and np.mean(found) < MOST_BAD:
            fit = value
    return fit


def roc(rows: Sequence[Row]) -> tuple[Array, Array, float]:
    """(n,) false and true alarm rates of the score for bad pairs, and the area under them."""
    told = [(expected_ghosts(row.whole), bad(row)) for row in judged(rows)]
    score = np.array([s for s, _ in told if s is not None])
    wrong = np.array([b for s, b in told if s is not None], bool)
    order = np.argsort(-score, kind="stable")
    hits = np.concatenate([[0.0], np.cumsum(wrong[order])])
    alarms = np.concatenate([[0.0], np.cumsum(~wrong[order])])
    if not hits[-1] or not alarms[-1]:
        return alarms, hits, float("nan")
    true, false = hits / hits[-1], alarms / alarms[-1]
    return false, true, float(np.trapezoid(true, false))


def truth_table(groups: Mapping[str, Sequence[Row]], gates: QualityOptions) -> str:
    """Markdown: per group and kind of pictures how statuses and truth go together."""
    out = [
        "| trees | pictures | pairs | good: ok / degraded / refused | bad: ok / degraded / refused "
        "| bad among ok % | right path lengths ok % | area under ROC |",
        "|---" * 8 + "|",
    ]
    for name, rows in groups.items():
        for pictures in ("all", *PICTURES):
            own = [row for row in judged(rows) if pictures in ("all", row.pictures)]
            if own:
                out.append(_line(name, pictures, own, gates))
    return "\n".join(out)


def _line(name: str, pictures: str, own: Sequence[Row], gates: QualityOptions) -> str:
    count = dict.fromkeys(((b, s) for b in (False, True) for s in (OK, DEGRADED, REFUSED)), 0)
    right = []
    for row in own:
        status = replayed(row, gates)
        count[bad(row), status] += 1
        if row.pictures == "path length" and row.kind == "same":
            right.append(status == OK)
    ok = count[True, OK] + count[False, OK]
    area = roc(own)[2]
    cells = [
        name, pictures, str(len(own)),
        *(" / ".join(str(count[b, s]) for s in (OK, DEGRADED, REFUSED)) for b in (False, True)),
        f"{100 * count[True, OK] / ok:.1f}" if ok else "-",
        f"{100 * np.mean(right):.0f}" if right else "-",
        "-" if np.isnan(area) else f"{area:.3f}",
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def draw(groups: Mapping[str, Sequence[Row]], gates: QualityOptions, file: Path) -> None:
    """Draw the ROC of the score, with the present gate, and DSC against the score."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    curve, cloud = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2)
    looks = (("#0072B2", "o"), ("#E69F00", "s"), ("#009E73", "^"))
    for (name, rows), (colour, mark) in zip(groups.items(), looks, strict=False):
        false, true, area = roc(rows)
        curve.plot(100 * false, 100 * true, color=colour, label=f"{name}: {area:.2f}")
        same = [row for row in rows if row.kind == "same" and row.whole.figures]
        cloud.plot(
            [100 * (expected_ghosts(row.whole) or 0.0) for row in same],
            [100 * (row.whole.dsc or 0.0) for row in same],
            mark, color=colour, label=name, markersize=4,
        )  # fmt: skip
    cloud.axvline(100 * gates.good_ghost_share, color="k", linestyle="--", linewidth=0.8)
    cloud.axhline(100 * BAD_DSC, color="k", linestyle=":", linewidth=0.8)
    curve.set(xlabel="good pairs above the gate, %", ylabel="bad pairs above the gate, %")
    cloud.set(xlabel="expected in ghosts, % of the length", ylabel="volume DSC, %")
    curve.legend(fontsize=8)
    with whole_file(file) as partial:
        figure.savefig(partial, dpi=110, format="png")
