"""What a training logs: one row per kind of scene and validation, and the curve drawn of them."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

from gcar_deploy.files import whole_file


def read_log(file: Path) -> list[dict[str, str]]:
    """Rows of a log.csv that are whole; none where there is no file.

    A line that was cut off says of no step that it was scored.
    """
    if not file.is_file():
        return []
    with file.open(newline="", encoding="utf-8", errors="replace") as f:
        lines = f.readlines()
    if lines and not lines[-1].endswith("\n"):
        lines.pop()
    rows = csv.DictReader(lines)
    return [row for row in rows if None not in (*row, *row.values()) and row["step"].isdigit()]


def draw_curve(rows: Sequence[Mapping[str, str]], file: Path) -> None:
    """Draw loss and every measure over the steps, one panel each, one line per kind."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if not rows:
        return
    names = [name for name in rows[0] if name not in ("step", "kind")]
    figure = Figure(figsize=(3.2 * len(names), 2.8), layout="constrained")
    FigureCanvasAgg(figure)
    for k, name in enumerate(names):
        panel = figure.add_subplot(1, len(names), k + 1)
        for kind in sorted({r["kind"] for r in rows}) if name != "loss" else [rows[0]["kind"]]:
            own = [r for r in rows if r["kind"] == kind]
            steps = [int(r["step"]) for r in own]
            panel.plot(steps, [float(r[name]) for r in own], label=kind, linewidth=1.2)
        panel.set_title(name, fontsize=9)
        panel.set_xlabel("step", fontsize=8)
        panel.tick_params(labelsize=7)
        if name != "loss":
            panel.legend(fontsize=6)
    with whole_file(file) as partial:
        figure.savefig(partial, dpi=110, format="png")
