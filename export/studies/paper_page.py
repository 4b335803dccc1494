"""The paper's two tables and two figures, in its layout, from a folder of rows that may grow.

Everything is an evaluation of the paper's set-up (``evaluate``): an interrupted run goes on, rows
of other settings are made again, and a page can be drawn at any time from what is there. A cell
whose row was not run is empty; a last table says what was run.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gcar_deploy.errors import UsageError
from gcar_export.evaluate import paper_tables
from gcar_export.evaluate.evaluate import EvaluateOptions, evaluate
from gcar_export.evaluate.plots import bars_over_views
from gcar_export.evaluate.tables import grouped
from gcar_export.methods.settings import DESCRIPTIONS, TRUE_DEPTH, MethodSettings

#: what is run, the most important first: methods and numbers of views
SWEEPS: Sequence[tuple[tuple[str, ...], tuple[int, ...]]] = (
    (("3dgr-gcp", "3dgr-fbp", "3dgr-gcp-l2"), (2,)),
    (("ours", "fdk", TRUE_DEPTH), (2,)),
    (("nerp",), (2,)),
    (("3dgr-gcp", "ours", "fdk", "nerp"), (4, 8, 16)),
    (("3dgr-fbp-l2", "3dgr-gcp-short", "3dgr-fbp-short", "3dgr-fbp-released"), (2,)),
)
REFERENCE = "3dgr-gcp"
#: methods of the two figures
FIGURE_METHODS = ("fdk", "nerp", "3dgr-gcp", "ours")


def run(
    data: Path,
    out: Path,
    *,
    paper_steps: int | None = None,
    cases: Sequence[str] = (),
    jobs: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> None:
    """Make what rows are missing.

    Parameters
    ----------
    data : folder with ``imagecas/`` and ``asoca/``
    out : folder of rows, as of ``evaluate``
    paper_steps : most iterations of the optimisation; None for the printed 8,000
    cases : only these; all if empty
    jobs : processes
    progress : called with (done, total, text), sweep by sweep

    Raises
    ------
    UsageError, ModelError
        As ``evaluate``.
    """
    settings = MethodSettings(paper_steps=paper_steps)
    for methods, views in SWEEPS:
        evaluate(
            EvaluateOptions(
                data=data, out=out, protocol="paper", methods=methods, views=views, jobs=jobs,
                cases=tuple(cases), settings=settings,
            ),
            progress,
        )  # fmt: skip


def read_rows(out: Path) -> list[dict[str, Any]]:
    """Rows of the paper's set-up below ``out``, in the order of case, views and method.

    Raises
    ------
    UsageError
        There are none.
    """
    found = [json.loads(path.read_text()) for path in sorted((out / "rows").glob("paper-*.json"))]
    rows = [row for row in found if row["method"] in DESCRIPTIONS]
    if not rows:
        raise UsageError(f"{out} holds no row of the paper's set-up: run it first")
    return rows


def page(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown: both tables beside the printed values, figures as numbers, what was run."""
    tables = paper_tables.layout(rows, REFERENCE)
    return "\n".join([tables, over_views(rows), what_was_run(rows)])


def draw(rows: Sequence[Mapping[str, Any]], out: Path) -> Path:
    """Draw both of the paper's figures into one picture; returns its path."""
    shown = in_every_figure(rows)
    order = {method: k for k, method in enumerate(FIGURE_METHODS)}
    shown.sort(key=lambda row: (order[row["method"]], row["views"], row["case"]))
    path = out / "paper-views.png"
    bars_over_views(shown, REFERENCE).savefig(path, dpi=80)
    return path


def in_every_figure(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of the figures' methods, of the trees that were seen from most numbers of views.

    Means over other trees at each number of views would say more of the trees than of the views.
    """
    shown = [dict(row) for row in rows if row["method"] in FIGURE_METHODS]
    seen: dict[str, set[int]] = {}
    for row in shown:
        if row["method"] == REFERENCE:
            seen.setdefault(row["case"], set()).add(row["views"])
    most = max((len(views) for views in seen.values()), default=0)
    return [row for row in shown if len(seen.get(row["case"], ())) == most]


def over_views(rows: Sequence[Mapping[str, Any]]) -> str:
    """Mean of the four columns by number of views; a cell that was not run is empty."""
    views = (2, 4, 8, 16)
    rows = in_every_figure(rows)
    out = ["### Figures of the paper as numbers: mean over trees, by number of views\n"]
    names = [paper_tables.MEASURES[c].heading for c in paper_tables.COLUMNS]
    for column, name in zip(paper_tables.COLUMNS, names, strict=True):
        unit = paper_tables.MEASURES[column]
        out += [f"| {name} | " + " | ".join(f"{n} views" for n in views) + " |"]
        out += ["|---" * (1 + len(views)) + "|"]
        for method in FIGURE_METHODS:
            cells = []
            for n in views:
                own = [
                    r["measures"][column]
                    for r in rows
                    if r["method"] == method and r["views"] == n
                    and r["measures"].get(column) is not None
                ]  # fmt: skip
                mean = unit.factor * sum(own) / len(own) if own else None
                cells.append("" if mean is None else f"{mean:.2f} (n={len(own)})")
            out.append(f"| {method} | " + " | ".join(cells) + " |")
        out.append("")
    return "\n".join(out)


def what_was_run(rows: Sequence[Mapping[str, Any]]) -> str:
    """Say which rows there are, what each cost, and how many were refused."""
    out = ["### What was run\n", "| row | views | trees | Gaussians | CPU s | without a result |"]
    out.append("|---" * 6 + "|")
    for (method, views), group in sorted(grouped(rows, ("method", "views")).items()):
        counts = [r["gaussians"] for r in group if r["gaussians"] is not None]
        gaussians = f"{sum(counts) / len(counts):.0f}" if counts else "-"
        cpu = sum(r["cpu_seconds"] for r in group) / len(group)
        without = sum(r["measures"].get("dsc") is None for r in group)
        cells = (DESCRIPTIONS[method], views, len(group), gaussians, f"{cpu:.1f}", without)
        out.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(out)
