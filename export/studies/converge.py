"""Curves of convergence: accuracy against the number of steps of the iterative methods.

Every point is a run of its own with that budget, learning rates falling over it as they would
in use; a method that ends earlier by its own rule keeps its figure from there on.
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from gcar_deploy.errors import UsageError
from gcar_deploy.files import is_free
from gcar_export.evaluate.evaluate import EvaluateOptions, evaluate
from gcar_export.evaluate.plots import figure, style
from gcar_export.evaluate.tables import grouped, summarise
from gcar_export.methods.settings import RUNTIME_ROWS, START_ROWS, MethodSettings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: methods with a number of steps.
ITERATIVE = (
    "nerp", *START_ROWS, *(name for name, row in RUNTIME_ROWS.items() if row.refiner == "paper"),
)  # fmt: skip
_HEAD = ("protocol", "case", "method", "steps", "dsc", "best_dsc", "seconds")


def converge(
    options: EvaluateOptions,
    steps: Sequence[int],
    on_progress: Callable[[int, int, str], None] | None = None,
) -> list[dict[str, Any]]:
    """Run every method with every budget; write ``converge.csv`` and ``converge.png``.

    Parameters
    ----------
    options : EvaluateOptions; rows of budget n go below ``out/steps-n`` and are kept there
    steps : budgets
    on_progress : as for ``evaluate``, counting all budgets

    Returns
    -------
    rows as of ``evaluate``, each with its ``steps``

    Raises
    ------
    UsageError
        A method has no steps, a budget is below 1, or ``options.out`` holds something else.
    """
    wrong = [m for m in options.methods if m not in ITERATIVE]
    if wrong:
        raise UsageError(f"{', '.join(wrong)} has no steps; there are {', '.join(ITERATIVE)}")
    if not steps or min(steps) < 1:
        raise UsageError(f"steps = {tuple(steps)!r} must be numbers from 1 on")
    if not any(options.out.glob("steps-*")) and not is_free(options.out):
        raise UsageError(f"{options.out} exists and holds no such study; choose another folder")
    rows = []
    for k, budget in enumerate(sorted(set(steps))):

        def progress(done: int, total: int, text: str, k: int = k, budget: int = budget) -> None:
            if on_progress is not None:
                on_progress(k * total + done, len(set(steps)) * total, f"{budget} steps: {text}")

        part = dataclasses.replace(
            options, out=options.out / f"steps-{budget}", settings=_limited(options, budget)
        )
        rows += [{**row, "steps": budget} for row in evaluate(part, progress)]
    with (options.out / "converge.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _HEAD, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows({**row, **row["measures"]} for row in rows)
    curves(rows).savefig(options.out / "converge.png", dpi=110)
    return rows


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown: methods down, budgets across; mean DSC at 0.5 (and at the best threshold)."""
    budgets = sorted({row["steps"] for row in rows})
    out = ["| method | " + " | ".join(f"{n} steps" for n in budgets) + " |"]
    out.append("|---" * (1 + len(budgets)) + "|")
    for (method,), group in grouped(rows, ("method",)).items():
        cells = []
        for (_,), part in sorted(grouped(group, ("steps",)).items()):
            (entry,) = summarise(part)
            cells.append(f"{_percent(entry['dsc'])} ({_percent(entry['best_dsc'])})")
        out.append(f"| {method} | " + " | ".join(cells) + " |")
    out.append("\nVolume DSC in %, at 0.5 and in brackets at the best threshold.")
    return "\n".join(out)


def curves(rows: Sequence[dict[str, Any]]) -> Figure:
    """Mean volume DSC against steps: solid at 0.5, dashed at the best threshold."""
    fig = figure(7.6, 4.4)
    axis = fig.subplots()
    for (method,), group in grouped(rows, ("method",)).items():
        colour, marker = style(method)
        parts = sorted(grouped(group, ("steps",)).items())
        at = [budget for (budget,), _ in parts]
        entries = [summarise(part)[0] for _, part in parts]
        for name, line in (("dsc", "-"), ("best_dsc", "--")):
            means = [entry[name]["mean"] for entry in entries]
            shown = [float("nan") if mean is None else 100 * mean for mean in means]
            axis.plot(
                at, shown, line, marker=marker, ms=5, color=colour,
                label=method if name == "dsc" else None,
            )  # fmt: skip
    axis.set_xscale("log")
    axis.set_xticks(sorted({row["steps"] for row in rows}), labels=None)
    axis.xaxis.set_major_formatter("{x:g}")
    axis.minorticks_off()
    axis.set_xlabel("steps allowed (each point a run of its own)")
    axis.set_ylabel("volume DSC, %")
    axis.grid(alpha=0.25)
    cases = len({row["case"] for row in rows})
    axis.set_title(
        f"{rows[0]['protocol']} protocol, {rows[0]['views']} views, {cases} "
        f"case{'s' if cases > 1 else ''}, mean; solid: at 0.5, dashed: best threshold",
        fontsize=10,
    )
    fig.legend(loc="outside lower center", ncols=4, frameon=False)
    return fig


def _limited(options: EvaluateOptions, steps: int) -> MethodSettings:
    nerp = dataclasses.replace(options.settings.nerp, steps=steps)
    return dataclasses.replace(options.settings, paper_steps=steps, nerp=nerp)


def _percent(entry: dict[str, Any]) -> str:
    return "-" if entry["mean"] is None else f"{100 * entry['mean']:.1f}"
