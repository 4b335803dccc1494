"""Figures of evaluations put into the documents that show them, so that nobody copies by hand.

``python -m gcar_export.evaluate.pages RESULTS README.md docs/results.md`` fills every block

    <!-- figures: NAME -->
    ...
    <!-- end -->

from ``RESULTS/NAME/cases.csv``, which ``gcar-export evaluate --out RESULTS/NAME`` left. The block
``overview`` has a line per protocol of ``OVERVIEW``; without its folder the line stays as it is.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from gcar_export.evaluate import peers, tables

#: protocol -> what was given; it lies in the folder that its name begins with
OVERVIEW: Mapping[str, str] = {
    "paper": "path lengths 128 x 128, two views at 90 deg, whole trees",
    "clinical": "path lengths 512 x 512, clinical angles, left trees",
    "raw": "raw 8-bit pictures of the same",
    "common-lca": "binary masks 256 x 256, left arteries",
    "common-rca": "binary masks 256 x 256, right arteries",
}
_SHOWN = ("dsc", "cldice", "chamfer_mm", "cpu_seconds")
_BLOCK = re.compile(r"(<!-- figures: ([\w-]+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def overview(results: Path, before: str = "") -> str:
    """One line per evaluated folder: what was given, mean and SD of the main measures, statuses.

    The line of a protocol without rows in ``results`` is that of the table ``before``.
    """
    old = {line.split(" | ")[0].strip("| "): line for line in before.splitlines()}
    columns = {name: {**tables.MEASURES, **tables.COUNTS}[name] for name in _SHOWN}
    head = ["given", "trees", *(c.heading for c in columns.values()), "ok / degraded / refused"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for name, given in OVERVIEW.items():
        file = results / name.split("-")[0] / "cases.csv"
        rows = [
            row for row in (tables.read_case_rows(file) if file.is_file() else [])
            if (row["protocol"], row["method"]) == (name, "ours")
        ]  # fmt: skip
        if not rows:
            lines += [old[given]] if given in old else []
            continue
        (entry,) = tables.summarise(rows)
        cells = [tables.mean_sd(entry[key], column, len(rows)) for key, column in columns.items()]
        lines.append("| " + " | ".join([given, str(len(rows)), *cells, _statuses(rows)]) + " |")
    return "\n".join(lines) + "\n"


def filled(text: str, results: Path) -> tuple[str, list[str]]:
    """Return a document with its blocks filled, and the names of blocks without figures."""
    missing = []

    def fill(block: re.Match[str]) -> str:
        name = block[2]
        if name == "overview":
            return f"{block[1]}{overview(results, block[3])}{block[4]}"
        file = results / name / "cases.csv"
        if not file.is_file():
            missing.append(name)
            return block[0]
        rows = tables.read_case_rows(file)
        methods = {row["method"] for row in rows}
        found = tables.markdown(rows, rows[0]["method"] if len(methods) > 1 else None)
        beside = peers.beside_peers(rows)
        return f"{block[1]}{found}{beside and chr(10) + beside}{block[4]}"

    return _BLOCK.sub(fill, text), missing


def _statuses(rows: Sequence[Mapping[str, Any]]) -> str:
    counted = Counter(row["status"] for row in rows)
    return " / ".join(str(counted[status]) for status in ("ok", "degraded", "refused"))


@click.command()
@click.argument("results", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("pages", nargs=-1, type=click.Path(exists=True, dir_okay=False, path_type=Path))
def main(results: Path, pages: tuple[Path, ...]) -> None:
    """Fill the figures of PAGES from the evaluations under RESULTS."""
    for page in pages:
        text, missing = filled(page.read_text(encoding="utf-8"), results)
        page.write_text(text, encoding="utf-8")
        click.echo(f"{page}: " + (f"no figures for {', '.join(missing)}" if missing else "filled"))


if __name__ == "__main__":
    main()
