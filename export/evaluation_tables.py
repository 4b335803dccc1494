"""Rows of an evaluation to tables: CSV per case, mean and SD, paired tests, markdown."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

#: measure -> (heading, digits, factor, +1 if more is better).
MEASURES: Mapping[str, tuple[str, int, float, int]] = {
    "dsc": ("DSC(0.5) %", 2, 100.0, 1),
    "best_dsc": ("best DSC %", 2, 100.0, 1),
    "ot_1mm": ("Ot(1 mm) %", 2, 100.0, 1),
    "ot_2mm": ("Ot(2 mm) %", 2, 100.0, 1),
    "chamfer_mm": ("Chamfer mm", 2, 1.0, -1),
    "cldice": ("clDice %", 2, 100.0, 1),
    "new_dsc": ("new-proj. DSC %", 2, 100.0, 1),
    "new_psnr_db": ("new-proj. PSNR dB", 2, 1.0, 1),
    "new_psnr_masked_db": ("masked PSNR dB", 2, 1.0, 1),
    "ssim": ("SSIM %", 2, 100.0, 1),
}
COUNTS: Mapping[str, tuple[str, int]] = {"gaussians": ("Gaussians", 0), "seconds": ("s", 2)}
#: p below -> stars, as in the paper's figures.
STARS = ((0.0001, "****"), (0.001, "***"), (0.01, "**"), (0.05, "*"))


def case_rows_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """One line per case, method and number of views; undefined is empty, with its reason."""
    stages = sorted({stage for row in rows for stage in row["stages"]} - {"total"})
    head = ["protocol", "case", "method", "views", "status", "sentence", *MEASURES]
    head += ["best_threshold", *COUNTS, *(f"seconds_{stage}" for stage in stages), "undefined"]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(head)
    for row in rows:
        cells = {**row, **{name: row["measures"].get(name) for name in MEASURES}}
        cells["best_threshold"] = row["measures"].get("best_threshold")
        cells.update({f"seconds_{stage}": row["stages"].get(stage) for stage in stages})
        cells["undefined"] = "; ".join(f"{k}: {v}" for k, v in sorted(row["reasons"].items()))
        writer.writerow(["" if cells.get(name) is None else cells[name] for name in head])
    return out.getvalue()


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Mean, SD (n - 1) and number of defined values per protocol, views and method."""
    out = []
    for key, group in _grouped(rows, ("protocol", "views", "method")).items():
        entry: dict[str, Any] = dict(zip(("protocol", "views", "method"), key, strict=True))
        entry["cases"] = len(group)
        for name in (*MEASURES, *COUNTS):
            values = [v for row in group if (v := _value(row, name)) is not None]
            entry[name] = {
                "mean": float(np.mean(values)) if values else None,
                "sd": float(np.std(values, ddof=1)) if len(values) > 1 else None,
                "n": len(values),
            }
        out.append(entry)
    return out


def paired_tests(rows: Sequence[Mapping[str, Any]], reference: str) -> list[dict[str, Any]]:
    """Two-sided Wilcoxon signed-rank tests of ``reference`` against every other method.

    Only cases on which both are defined are paired; without a pair, or when all differences
    are zero, p is None with a reason.
    """
    out = []
    for (protocol, views), group in _grouped(rows, ("protocol", "views")).items():
        by_method = _grouped(group, ("method",))
        mine = {row["case"]: row for row in by_method.get((reference,), [])}
        for (method,), others in by_method.items():
            if method == reference or not mine:
                continue
            for name in MEASURES:
                pairs = [
                    (a, b)
                    for row in others
                    if row["case"] in mine
                    and (a := _value(mine[row["case"]], name)) is not None
                    and (b := _value(row, name)) is not None
                ]
                out.append(
                    {
                        "protocol": protocol,
                        "views": views,
                        "measure": name,
                        "reference": reference,
                        "method": method,
                        **_wilcoxon(pairs),
                    }
                )
    return out


def markdown(rows: Sequence[Mapping[str, Any]], reference: str | None = None) -> str:
    """Tables (mean and SD, stars against ``reference``), one per protocol and views."""
    tests = {} if reference is None else {
        (t["protocol"], t["views"], t["method"], t["measure"]): t["stars"]
        for t in paired_tests(rows, reference)
    }  # fmt: skip
    out = []
    for (protocol, views), group in _grouped(summarise(rows), ("protocol", "views")).items():
        out.append(f"### {protocol} protocol, {views} views, {group[0]['cases']} cases\n")
        heads = ["method", *(m[0] for m in MEASURES.values()), *(c[0] for c in COUNTS.values())]
        out.append("| " + " | ".join(heads) + " |")
        out.append("|---" * len(heads) + "|")
        for entry in group:
            cells = [entry["method"]]
            for name, (_, digits, factor, _) in MEASURES.items():
                stars = tests.get((protocol, views, entry["method"], name), "")
                cells.append(_cell(entry[name], digits, factor, entry["cases"]) + stars)
            for name, (_, digits) in COUNTS.items():
                cells.append(_cell(entry[name], digits, 1.0, entry["cases"]))
            out.append("| " + " | ".join(cells) + " |")
        out.append("")
    out.append("Mean +- SD. (n=k) where a measure is defined for fewer cases than the table has.")
    if reference is not None:
        out.append(f"Wilcoxon signed rank against {reference}: {_star_key()}.")
    return "\n".join(out) + "\n"


def _star_key() -> str:
    return ", ".join(f"{stars} p < {level}" for level, stars in reversed(STARS))


def _cell(entry: Mapping[str, Any], digits: int, factor: float, cases: int) -> str:
    if entry["mean"] is None:
        return "-"
    text = f"{entry['mean'] * factor:.{digits}f}"
    if entry["sd"] is not None:
        text += f" ± {entry['sd'] * factor:.{digits}f}"
    return text if entry["n"] == cases else f"{text} (n={entry['n']})"


def _value(row: Mapping[str, Any], name: str) -> float | None:
    value = row[name] if name in COUNTS else row["measures"].get(name)
    return None if value is None else float(value)


def _wilcoxon(pairs: Sequence[tuple[float, float]]) -> dict[str, Any]:
    from scipy.stats import wilcoxon

    empty = {"n": len(pairs), "mean_difference": None, "p": None, "stars": ""}
    if not pairs:
        return {**empty, "reason": "no case on which both are defined"}
    difference = np.array([a - b for a, b in pairs])
    mean = float(difference.mean())
    if not difference.any():
        return {**empty, "mean_difference": mean, "reason": "all differences are zero"}
    p = float(wilcoxon(difference).pvalue)
    if not math.isfinite(p):
        return {**empty, "mean_difference": mean, "reason": "test undefined"}
    stars = next((stars for level, stars in STARS if p < level), "")
    return {"n": len(pairs), "mean_difference": mean, "p": p, "stars": stars, "reason": None}


def _grouped(
    rows: Sequence[Mapping[str, Any]], keys: Sequence[str]
) -> dict[tuple[Any, ...], list[Mapping[str, Any]]]:
    out: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        out.setdefault(tuple(row[key] for key in keys), []).append(row)
    return out
