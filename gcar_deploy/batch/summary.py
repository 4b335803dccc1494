"""summary.csv and summary.html of a batch."""

from __future__ import annotations

import base64
import csv
import html
import io
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import quote

from gcar_deploy.batch.work import COLUMNS
from gcar_deploy.files import whole_file
from gcar_deploy.output.report import page_policy
from gcar_deploy.reconstruction import RESEARCH_USE

_TEMPLATE = "summary_template.html"
#: key, heading, unit, decimals (None: words)
_SHOWN = (
    ("status", "Status", "", None), ("branches", "Branches", "", 0),
    ("length_mm", "Length", "mm", 0), ("separation_deg", "View separation", "deg", 0),
    ("least_coverage", "Least coverage", "% weighed by thickness", 0),
    ("largest_stenosis_percent", "Largest stenosis", "%", 0), ("seconds", "Time", "s", 1),
    ("sentence", "Why", "", None),
)  # fmt: skip
#: shares are shown in percent
_FACTORS = {"least_coverage": 100.0}
#: pictures of a case beside its name, pixels high
_THUMBNAILS, _THUMBNAIL_PX = 2, 96


def write_summary(rows: Sequence[Mapping[str, Any]], out: Path, *, of: int | None = None) -> None:
    """Write both files; an earlier summary of the same batch is replaced.

    Parameters
    ----------
    of : cases in all, where some have no row yet
    """
    page = summary_html(rows, out, of=of)
    for name, text in (("summary.csv", summary_csv(rows)), ("summary.html", page)):
        with whole_file(out / name) as partial:
            partial.write_text(text, encoding="utf-8", newline="")


def summary_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """One line a case; what does not exist is an empty field."""
    stream = io.StringIO(newline="")
    writer = csv.DictWriter(stream, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: "" if row.get(name) is None else row[name] for name in COLUMNS})
    return stream.getvalue()


def summary_html(rows: Sequence[Mapping[str, Any]], out: Path, *, of: int | None = None) -> str:
    """One page with a line a case, linked to its report; sorted and filtered by the page itself.

    Parameters
    ----------
    rows : one a case
    out : folder of the batch, whose cases' overlays are shown small
    of : as ``write_summary``

    Returns
    -------
    HTML text; script and style inside, allowed by their hashes and nothing else
    """
    template = resources.files("gcar_deploy.batch").joinpath(_TEMPLATE).read_text("utf-8")
    counts = Counter(str(row["status"]) for row in rows)
    said = ", ".join(f"{number} {status}" for status, number in sorted(counts.items()))
    count = f"{len(rows)} cases" if of in (None, len(rows)) else f"{len(rows)} of {of} cases"
    parts = {
        "TITLE": html.escape(f"{count}: {said}" if rows else "no cases"),
        "HEAD": _head("Case", "", "words") + "<th><span>Views</span></th>"
        + "".join(
            _head(name, unit, "words" if digits is None else "") for _, name, unit, digits in _SHOWN
        ),
        "ROWS": "".join(_line(row, out) for row in rows),
        "USE": html.escape(RESEARCH_USE),
    }  # fmt: skip
    page = re.sub("__([A-Z]+)__", lambda mark: parts.get(mark[1], mark[0]), template)
    return page.replace("__CSP__", page_policy(page), 1)


def _head(name: str, unit: str, kind: str) -> str:
    small = f"<small>{unit}</small>" if unit else ""
    return f'<th scope="col" class="{kind}"><button type="button">{name}</button>{small}</th>'


def _line(row: Mapping[str, Any], out: Path) -> str:
    name, status = html.escape(str(row["case"])), html.escape(str(row["status"]))
    done = row["status"] in ("ok", "degraded")
    link = f'<a href="{html.escape(quote(str(row["case"])))}/report.html">{name}</a>'
    pictures = _thumbnails(out / str(row["case"])) if done else ""
    cells = [
        f'<td class="name words" data-value="{name}">{link if done else name}</td>',
        f'<td class="pictures">{pictures}</td>',
    ]
    for key, title, unit, digits in _SHOWN:
        value = row.get(key)
        if digits is None:
            kind = f"status {status}" if key == "status" else "why words"
            text = html.escape("-" if value is None else str(value))
            cells.append(f'<td class="{kind}" data-value="{text}">{text}</td>')
        elif value is None:
            cells.append(f'<td class="number" data-name="{title}">-</td>')
        else:
            number = _FACTORS.get(key, 1.0) * float(value)
            told = f'data-name="{title}{f", {unit}" if unit else ""}" data-value="{number:.6g}"'
            cells.append(f'<td class="number" {told}>{number:.{digits}f}</td>')
    return f'<tr data-status="{status}">{"".join(cells)}</tr>'


def _thumbnails(folder: Path) -> str:
    """Return small overlays of a result folder, as part of the page; nothing where it is gone."""
    import cv2

    from gcar_deploy.imaging.read import quiet_decoder

    found = []
    for k in range(1, _THUMBNAILS + 1):
        # Decoded at a quarter of the size: a page of many cases is made in a moment.
        with quiet_decoder():
            picture = cv2.imread(str(folder / f"overlay_view{k}.png"), cv2.IMREAD_REDUCED_COLOR_4)
        if picture is None:
            continue
        scale = _THUMBNAIL_PX / picture.shape[0]
        size = (max(1, round(scale * picture.shape[1])), _THUMBNAIL_PX)
        small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 70])[1].tobytes()
        text = base64.b64encode(data).decode("ascii")
        found.append(f'<img alt="view {k}" src="data:image/jpeg;base64,{text}">')
    return "".join(found)
