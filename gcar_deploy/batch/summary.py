"""summary.csv and summary.html of a batch."""

from __future__ import annotations

import base64
import csv
import hashlib
import html
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gcar_deploy.batch.work import COLUMNS
from gcar_deploy.reconstruction import RESEARCH_USE

_STYLE = """
body { margin: 0 auto; max-width: 1280px; padding: 16px; color: #1c2430; background: #f5f7fa;
  font: 15px/1.45 system-ui, sans-serif; }
table { border-collapse: collapse; width: 100%; background: #fff; font-size: 14px;
  font-variant-numeric: tabular-nums; }
th, td { padding: 6px 10px; border-bottom: 1px solid #d9dee6; text-align: right; }
th:first-child, td:first-child, .words { text-align: left; overflow-wrap: anywhere; }
td.ok { color: #1d6b41; } td.degraded { color: #9a6200; }
td.refused, td.failed { color: #b03024; }
p { color: #5b6675; }
"""
_SHOWN = (
    ("status", "Status", ""), ("branches", "Branches", ""), ("length_mm", "Length", " mm"),
    ("separation_deg", "View separation", " deg"), ("least_coverage", "Least coverage", ""),
    ("largest_stenosis_percent", "Largest stenosis", " %"), ("seconds", "Time", " s"),
    ("sentence", "Why", ""),
)  # fmt: skip


def write_summary(rows: Sequence[Mapping[str, Any]], out: Path) -> None:
    """Write both files; an earlier summary of the same batch is replaced."""
    for name, text in (("summary.csv", summary_csv(rows)), ("summary.html", summary_html(rows))):
        partial = out / f"{name}.partial"
        partial.write_text(text, encoding="utf-8", newline="")
        partial.replace(out / name)


def summary_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """One line a case; what does not exist is an empty field."""
    stream = io.StringIO(newline="")
    writer = csv.DictWriter(stream, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: "" if row.get(name) is None else row[name] for name in COLUMNS})
    return stream.getvalue()


def summary_html(rows: Sequence[Mapping[str, Any]]) -> str:
    """One page with a line a case, linked to its report; no script, nothing fetched."""
    counts = Counter(str(row["status"]) for row in rows)
    said = ", ".join(f"{number} {status}" for status, number in sorted(counts.items()))
    digest = base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode("ascii")
    head = "".join(
        f'<th class="words">{name}</th>' if key == "sentence" else f"<th>{name}</th>"
        for key, name, _ in _SHOWN
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
        f"style-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'\">"
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{len(rows)} cases: {html.escape(said)}</title><style>{_STYLE}</style></head>"
        f"<body><h1>{len(rows)} cases: {html.escape(said)}</h1>"
        f"<table><thead><tr><th>Case</th>{head}</tr></thead><tbody>"
        f"{''.join(_line(row) for row in rows)}</tbody></table>"
        f"<p>{html.escape(RESEARCH_USE)}</p></body></html>\n"
    )


def _line(row: Mapping[str, Any]) -> str:
    name = html.escape(str(row["case"]))
    done = row["status"] in ("ok", "degraded")
    cells = [f'<td><a href="{name}/report.html">{name}</a></td>' if done else f"<td>{name}</td>"]
    for key, _, unit in _SHOWN:
        value = row.get(key)
        text = "-" if value is None else f"{value:g}{unit}" if isinstance(value, float) else value
        kind = {"status": html.escape(str(value)), "sentence": "words"}.get(key, "")
        cells.append(f'<td class="{kind}">{html.escape(str(text))}</td>')
    return f"<tr>{''.join(cells)}</tr>"
