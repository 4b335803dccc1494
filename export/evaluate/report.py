"""Pictures of an evaluation and one self-contained page that holds them with the tables."""

from __future__ import annotations

import base64
import html
import io
import json
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gcar_deploy.types import Array
from gcar_export.evaluate import paper_tables, peers, tables
from gcar_export.evaluate.jobs import TRUTH, sides_path
from gcar_export.evaluate.plots import all_figures, figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: occupancy, of 255, that counts as vessel in the pictures of trees.
HALF = 128
BOTH, GHOST, MISSED = (235, 235, 235), (230, 60, 40), (60, 130, 255)
#: pixels left round the tree.
MARGIN = 8
SIDES = ("from the front", "from the left", "from above")
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1500px;
       padding: 0 1rem; color: #222; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; font-size: 13px; }
th, td { border: 1px solid #ccc; padding: .25rem .5rem; text-align: right; white-space: nowrap; }
th:first-child, td:first-child, td:nth-child(2) { text-align: left; }
img { max-width: 100%; height: auto; } pre { font-size: 12px; overflow-x: auto; }
"""


def draw(rows: Sequence[Mapping[str, Any]], out: Path, reference: str) -> Path:
    """Write ``pictures/*.png`` and ``report.html`` below ``out``; return the report's path.

    Trees are drawn from ``sides/*.png``; rows without one (no volume) leave their place empty.
    """
    pictures = out / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)
    made: dict[str, bytes] = {}
    figures = {**all_figures(rows, reference), **_tree_figures(rows, out)}
    for stem, fig in figures.items():
        made[stem] = _png(fig)
        (pictures / f"{stem}.png").write_bytes(made[stem])
    report = out / "report.html"
    report.write_text(_page(rows, out, reference, made), encoding="utf-8")
    return report


def tree_figure(out: Path, protocol: str, case: str, views: int, methods: Sequence[str]) -> Figure:
    """Draw the trees of all methods beside the truth, from three sides.

    White: in both; red: in the method's tree alone; blue: in the truth alone. Occupancy counts
    from 0.5; where no voxel reaches that, the tree's grey values are shown as they are.
    """
    truth = _read(sides_path(out, protocol, case, views, TRUTH))
    fig = figure(1.55 * (len(methods) + 1), 5.3)
    axes = fig.subplots(3, len(methods) + 1, squeeze=False)
    for column, method in enumerate((TRUTH, *methods)):
        sides = _read(sides_path(out, protocol, case, views, method))
        parts = [None] * 3 if sides is None or truth is None else _split(sides, truth)
        boxes: Any = [None] * 3 if truth is None else _boxes(truth)
        title = method
        if sides is not None and sides.max() < HALF:
            title += "\n(below 0.5: grey)"
        for row, part in enumerate(parts):
            axis = axes[row, column]
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_facecolor("black")
            if part is None:
                axis.text(0.5, 0.5, "none", ha="center", color="white", transform=axis.transAxes)
                axis.set_aspect("equal")
            else:
                axis.imshow(part, interpolation="nearest")
                left, right, top, bottom = boxes[row]
                axis.set_xlim(left, right)
                axis.set_ylim(bottom, top)
            if column == 0:
                axis.set_ylabel(SIDES[row])
        axes[0, column].set_title(title, fontsize=9)
    title = (
        f"{case}, {protocol} protocol, {views} views: white in both, red in the method's alone, "
        "blue missed"
    )
    # A figure of one method is narrow.
    fig.suptitle(textwrap.fill(title, int(12 * fig.get_figwidth())), fontsize=10)
    return fig


def _tree_figures(rows: Sequence[Mapping[str, Any]], out: Path) -> dict[str, Figure]:
    """One figure per protocol and case, for its smallest number of views."""
    figures = {}
    for (protocol, case), group in tables.grouped(rows, ("protocol", "case")).items():
        views = min(row["views"] for row in group)
        methods = [row["method"] for row in group if row["views"] == views]
        if sides_path(out, protocol, case, views, TRUTH).is_file():
            figures[f"trees-{protocol}-{case}-{views}"] = tree_figure(
                out, protocol, case, views, methods
            )
    return figures


def _boxes(truth: Array) -> list[tuple[float, float, float, float]]:
    """Left, right, top, bottom of a square round the truth in each side, pixels."""
    squares = []
    parts = np.array_split(truth >= HALF, 3, axis=1)
    ranges = [[np.flatnonzero(part.any(axis)) for axis in (0, 1)] for part in parts]
    spans = [np.ptp(hit) + 1 for pair in ranges for hit in pair if len(hit)]
    half = 0.5 * (max(spans) if spans else min(parts[0].shape)) + MARGIN
    for part, pair in zip(parts, ranges, strict=True):
        x, y = (
            0.5 * (hit[0] + hit[-1]) if len(hit) else 0.5 * n
            for hit, n in zip(pair, part.shape[::-1], strict=True)
        )
        squares.append((x - half, x + half, y - half, y + half))
    return squares


def _split(sides: Array, truth: Array) -> list[Array]:
    """(rows, columns, 3) uint8 of each side; the grids of all protocols are cubes."""
    if sides.max() < HALF:
        shown = np.repeat((sides.astype(np.float64) / max(sides.max(), 1))[..., None], 3, axis=2)
        return list(np.array_split(np.rint(255 * shown).astype(np.uint8), 3, axis=1))
    made, true = sides >= HALF, truth >= HALF
    out = np.zeros((*sides.shape, 3), np.uint8)
    out[made & true], out[made & ~true], out[~made & true] = BOTH, GHOST, MISSED
    return list(np.array_split(out, 3, axis=1))


def _read(path: Path) -> Array | None:
    import cv2

    if not path.is_file():
        return None
    return cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)


def _png(fig: Figure) -> bytes:
    buffer = io.BytesIO()
    fig.savefig(buffer, dpi=110)
    return buffer.getvalue()


def _page(
    rows: Sequence[Mapping[str, Any]], out: Path, reference: str, pictures: Mapping[str, bytes]
) -> str:
    parts = ["<h1>Evaluation</h1>"]
    parts.append(
        "<p>Research use only. Volume DSC: occupancy &ge; 0.5 against &ge; 0.5, whole volume; "
        "new projections: path length &ge; 0.5 mm, PSNR with the truth's maximum as peak, over "
        "all pixels and (masked) over those with truth &gt; 0; Ot and Chamfer between "
        "skeletons; SSIM of volumes, data range 1. Undefined is left out and counted, never "
        "taken for 0 or 1.</p>"
    )
    parts.append(_html(tables.markdown(rows, reference)))
    parts.append(_html(tables.over_views(rows)))
    parts.append(_html(paper_tables.layout(rows, reference)))
    parts.append(_html(peers.beside_peers(rows)))
    short = tables.not_first(rows, reference) + tables.worse_with_views(rows, reference)
    parts.append(f"<h2>Where {html.escape(reference)} is not first with p &lt; 0.05</h2><ul>")
    parts += [f"<li>{html.escape(sentence)}</li>" for sentence in short] or ["<li>nowhere</li>"]
    parts.append("</ul><h2>Pictures</h2>")
    for stem, png in pictures.items():
        data = base64.b64encode(png).decode()
        alt = html.escape(stem)
        parts.append(f'<p><img alt="{alt}" src="data:image/png;base64,{data}"></p>')
    settings = out / "settings.json"
    if settings.is_file():
        text = json.dumps(json.loads(settings.read_text()), indent=1)
        parts.append("<details><summary>Settings of every row</summary>")
        parts.append(f"<pre>{html.escape(text)}</pre></details>")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>gcar evaluation</title>'
        f"<style>{_STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )


def _html(markdown: str) -> str:
    """Headings, tables and lines of the project's own markdown as HTML."""
    out, table = [], False
    for line in markdown.splitlines():
        if line.startswith("|---"):
            continue
        if line.startswith("|"):
            cells = [html.escape(cell.strip(" *")) for cell in line.strip("|").split("|")]
            kind = "td" if table else "th"
            if not table:
                out.append('<div class="scroll"><table>')
            out.append("<tr>" + "".join(f"<{kind}>{c}</{kind}>" for c in cells) + "</tr>")
            table = True
            continue
        if table:
            out.append("</table></div>")
            table = False
        if line.startswith("### "):
            out.append(f"<h2>{html.escape(line[4:])}</h2>")
        elif line:
            out.append(f"<p>{html.escape(line)}</p>")
    return "\n".join([*out, "</table></div>" if table else ""])
