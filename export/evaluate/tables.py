"""Rows of an evaluation to tables: CSV per case and back, mean and SD, paired tests, markdown."""

from __future__ import annotations

import csv
import io
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gcar_deploy.errors import UsageError


class Column(NamedTuple):
    """How a figure is shown: heading with unit, digits, factor, +1 if more is better."""

    heading: str
    digits: int = 2
    factor: float = 100.0
    better: int = 1


MEASURES: Mapping[str, Column] = {
    "dsc": Column("DSC(0.5) %"),
    "shifted_dsc": Column("DSC(0.5), common shift allowed %"),
    "best_dsc": Column("best DSC %"),
    "ot_1mm": Column("Ot(1 mm) %"),
    "ot_2mm": Column("Ot(2 mm) %"),
    "chamfer_mm": Column("Chamfer mm", factor=1.0, better=-1),
    "cldice": Column("clDice %"),
    "cd_mm": Column("CD (sum) mm", factor=1.0, better=-1),
    "parts": Column("components", factor=1.0, better=-1),
    "found_1mm": Column("centreline found within 1 mm %"),
    "true_1mm": Column("true lines within 1 mm of ours %"),
    "new_dsc": Column("new-proj. DSC %"),
    "new_psnr_db": Column("new-proj. PSNR dB", factor=1.0),
    "new_psnr_masked_db": Column("masked PSNR dB", factor=1.0),
    "ssim": Column("SSIM %"),
}
COUNTS: Mapping[str, Column] = {
    "gaussians": Column("Gaussians", digits=0, factor=1.0, better=0),
    "seconds": Column("s", factor=1.0, better=-1),
    "cpu_seconds": Column("CPU s", factor=1.0, better=-1),
}
#: measures that some protocols have, shown where one does
SOME = (
    "shifted_dsc", "cd_mm", "parts", "found_1mm", "true_1mm",
    "new_dsc", "new_psnr_db", "new_psnr_masked_db", "ssim",
)  # fmt: skip
_NAMES = ("protocol", "dataset", "case", "method", "views", "status", "sentence", "models")
#: p below -> stars, as in the paper's figures.
STARS = ((0.0001, "****"), (0.001, "***"), (0.01, "**"), (0.05, "*"))


def case_rows_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """One line per case, method and number of views; undefined is empty, with its reason."""
    stages = sorted({stage for row in rows for stage in row["stages"]})
    head = [*_NAMES, *MEASURES]
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


def read_case_rows(path: Path) -> list[dict[str, Any]]:
    """Read rows back from what ``case_rows_csv`` wrote.

    Raises
    ------
    UsageError
        There is no such file, or it is no such table.
    """
    if not path.is_file():
        raise UsageError(f"{path} is missing: nothing was evaluated there")
    with path.open(newline="", encoding="utf-8") as file:
        cells = list(csv.DictReader(file))
    try:
        return [_row_of(line) for line in cells]
    except (KeyError, ValueError) as error:
        raise UsageError(f"{path} is not a table of cases: {error}") from None


def _row_of(line: Mapping[str, str]) -> dict[str, Any]:
    number = {name: float(text) if text else None for name, text in line.items() if (
        name in MEASURES or name in COUNTS or name == "best_threshold"
        or name.startswith("seconds_"))}  # fmt: skip
    reasons = [part.split(": ", 1) for part in line["undefined"].split("; ") if part]
    stages = {k.removeprefix("seconds_"): v for k, v in number.items() if k.startswith("seconds_")}
    return {
        # Tables of earlier versions know no models of the user's own.
        **{name: line[name] for name in _NAMES if name != "models"},
        "models": line.get("models", ""),
        "views": int(line["views"]),
        "measures": {name: number.get(name) for name in (*MEASURES, "best_threshold")},
        "reasons": dict(reasons),
        **{name: number[name] for name in COUNTS},
        "stages": {stage: seconds for stage, seconds in stages.items() if seconds is not None},
    }


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Mean, SD (n - 1) and number of defined values per protocol, views and method."""
    out = []
    for key, group in grouped(rows, ("protocol", "views", "method")).items():
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
    for (protocol, views), group in grouped(rows, ("protocol", "views")).items():
        by_method = grouped(group, ("method",))
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
    for (protocol, views), group in grouped(summarise(rows), ("protocol", "views")).items():
        cases = max(entry["cases"] for entry in group)
        columns = {
            name: column
            for name, column in {**MEASURES, **COUNTS}.items()
            if name not in SOME or any(entry[name]["n"] for entry in group)
        }
        out.append(f"### {protocol} protocol, {views} views, {cases} cases\n")
        out.append("| " + " | ".join(["method", *(c.heading for c in columns.values())]) + " |")
        out.append("|---" * (1 + len(columns)) + "|")
        for entry in group:
            cells = [entry["method"]]
            for name, column in columns.items():
                stars = tests.get((protocol, views, entry["method"], name), "")
                cells.append(mean_sd(entry[name], column, cases) + stars)
            out.append("| " + " | ".join(cells) + " |")
        out.append("")
    out += _own_models(rows)
    out.append("Mean ± SD. (n=k) where a measure is defined for fewer cases than the table has.")
    if reference is not None:
        out.append(f"Wilcoxon signed rank against {reference}: {_star_key()}.")
    return "\n".join(out) + "\n"


def _own_models(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Lines, one for each choice of the user's own models, with the methods that asked them."""
    lines = []
    for (models,), group in grouped([r for r in rows if r.get("models")], ("models",)).items():
        methods = ", ".join(dict.fromkeys(row["method"] for row in group))
        lines.append(f"{methods}: with {models}, not with what comes along.\n")
    return lines


def over_views(rows: Sequence[Mapping[str, Any]], name: str = "dsc") -> str:
    """Markdown of one measure, methods down and numbers of views across, per protocol.

    Empty where no protocol has more than one number of views.
    """
    out = []
    column = MEASURES[name]
    for (protocol,), group in grouped(summarise(rows), ("protocol",)).items():
        views = sorted({entry["views"] for entry in group})
        if len(views) < 2:
            continue
        out.append(f"### {protocol} protocol, {column.heading} by number of views\n")
        out.append("| method | " + " | ".join(f"{n} views" for n in views) + " |")
        out.append("|---" * (1 + len(views)) + "|")
        for (method,), entries in grouped(group, ("method",)).items():
            at = {e["views"]: mean_sd(e[name], column, 0) for e in entries}
            out.append(f"| {method} | " + " | ".join(at.get(n, "") for n in views) + " |")
        out.append("")
    return "\n".join(out)


def worse_with_views(rows: Sequence[Mapping[str, Any]], method: str) -> list[str]:
    """Sentences, one for each step to more views at which ``method`` loses in the mean."""
    out = []
    mine = [row for row in rows if row["method"] == method]
    for (protocol,), group in grouped(summarise(mine), ("protocol",)).items():
        steps = sorted(group, key=lambda entry: int(entry["views"]))
        for few, many in itertools.pairwise(steps):
            for name, column in MEASURES.items():
                a, b = few[name]["mean"], many[name]["mean"]
                if a is None or b is None or (b - a) * column.better >= 0:
                    continue
                out.append(
                    f"{protocol}, {column.heading}: {method} loses "
                    f"{abs(b - a) * column.factor:.2f} from {few['views']} to {many['views']} views"
                )
    return out


def not_first(rows: Sequence[Mapping[str, Any]], reference: str) -> list[str]:
    """Sentences, one for each column where ``reference`` is not first with p < 0.05."""
    out = []
    for (protocol, views), group in grouped(rows, ("protocol", "views")).items():
        tests = [t for t in paired_tests(group, reference) if t["n"]]
        for (name,), column_tests in grouped(tests, ("measure",)).items():
            column = MEASURES[name]
            behind, close, equal = [], [], []
            for test in column_tests:
                if not test["mean_difference"] and test["p"] is None:
                    equal.append(f"{test['method']} (n={test['n']})")
                    continue
                ahead = test["mean_difference"] * column.better * column.factor
                p = test["reason"] if test["p"] is None else f"p = {test['p']:.3f}"
                if ahead <= 0:
                    behind.append(f"{test['method']} leads by {-ahead:.2f} ({p}, n={test['n']})")
                elif test["p"] is None or test["p"] >= 0.05:
                    close.append(f"{test['method']} (by {ahead:.2f}, {p}, n={test['n']})")
            if close:
                behind.append(f"not significantly ahead of {', '.join(close)}")
            if equal:
                behind.append(f"equal in every case: {', '.join(equal)}")
            if behind:
                where = f"{protocol}, {views} views, {column.heading}"
                out.append(f"{where}: {'; '.join(behind)}")
    return out


def _star_key() -> str:
    return ", ".join(f"{stars} p < {level}" for level, stars in reversed(STARS))


def mean_sd(entry: Mapping[str, Any], column: Column, cases: int) -> str:
    """``mean ± SD`` of an entry of ``summarise``, with (n=k) if fewer than ``cases``; ``-``."""
    if entry["mean"] is None:
        return "-"
    text = f"{entry['mean'] * column.factor:.{column.digits}f}"
    if entry["sd"] is not None:
        text += f" ± {entry['sd'] * column.factor:.{column.digits}f}"
    return text if entry["n"] >= cases else f"{text} (n={entry['n']})"


def _value(row: Mapping[str, Any], name: str) -> float | None:
    value = row.get(name) if name in COUNTS else row["measures"].get(name)
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


def grouped(
    rows: Sequence[Mapping[str, Any]], keys: Sequence[str]
) -> dict[tuple[Any, ...], list[Mapping[str, Any]]]:
    """Rows by the values of ``keys``, in the order of their first appearance."""
    out: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        out.setdefault(tuple(row[key] for key in keys), []).append(row)
    return out
