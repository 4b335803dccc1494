"""Rows of a table of pairs: how much of the line is found, how much is true, which statuses."""

from __future__ import annotations

from collections.abc import Container, Sequence

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.types import Points

#: share of the true line found, share of ours that is true, status (``refused``: both 0)
Judged = tuple[float, float, str]


def shares(points_mm: Points, line_mm: Points, near_mm: float) -> tuple[float, float]:
    """Share of (m, 3) true points with one of (n, 3) ours near by, and of ours with a true one."""
    found = cKDTree(points_mm).query(line_mm)[0] <= near_mm
    ours = cKDTree(line_mm).query(points_mm)[0] <= near_mm
    return float(found.mean()), float(ours.mean())


def judge(
    engine: Engine, views: Sequence[Angiogram], grid: Grid, line_mm: Points, near_mm: float
) -> Judged:
    """Reconstruct a scene and hold it against (m, 3) points of its true line, mm."""
    try:
        found = engine.reconstruct(views, grid)
    except GcarError:
        return 0.0, 0.0, "refused"
    return *shares(found.tree.points(), line_mm, near_mm), found.status


def head(first: str, near_mm: float, counted: str = "pairs") -> str:
    """Head of the table, Markdown; ``first`` names the pictures, ``counted`` what is counted."""
    names = (
        first, counted, f"true line found within {near_mm:g} mm %", "ours that is true %",
        "F %, refused 0", "ok / degraded / refused", "least F of an ok %",
    )  # fmt: skip
    return f"| {' | '.join(names)} |\n" + "|---" * len(names) + "|"


def row(name: str, judged: Sequence[Judged], *, known: bool = True) -> str:
    """Line of the table; the shares are means over all pairs that were not refused.

    With ``known`` false there is no true line: statuses alone.
    """
    states = [status for *_, status in judged]
    found, ours = np.array([shares for *shares, _ in judged]).T
    both = 200 * found * ours / np.maximum(found + ours, 1e-9)
    made = np.array([status != "refused" for status in states])
    figures = ["-"] * 3
    if known:
        shown = (100 * share[made].mean() if made.any() else 0.0 for share in (found, ours))
        figures = [*(f"{value:.1f}" for value in shown), f"{both.mean():.1f}"]
    counts = " / ".join(str(states.count(s)) for s in ("ok", "degraded", "refused"))
    sure = [f for f, status in zip(both, states, strict=True) if status == "ok"]
    least = f"{min(sure):.1f}" if sure else "-"
    return f"| {name} | {len(judged)} | {' | '.join(figures)} | {counts} | {least} |"


def table_by_name(
    rows: Sequence[tuple[str, *Judged]], first: str, near_mm: float, unknown: Container[str] = ()
) -> str:
    """Table with a line for each name that rows begin with; of ``unknown`` ones statuses alone."""
    out = [head(first, near_mm)]
    for name in dict.fromkeys(own[0] for own in rows):
        judged = [own[1:] for own in rows if own[0] == name]
        out.append(row(name, judged, known=name not in unknown))
    return "\n".join(out)
