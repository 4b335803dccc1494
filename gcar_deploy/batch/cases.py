"""The table of cases: one line a case, read and judged before anything runs."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gcar_deploy.errors import UsageError

#: names become folders
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_VIEW = re.compile(r"view([1-9][0-9]?)")
_RESERVED = ("rows", "summary.csv", "summary.html", "batch.json")
MOST_CASES = 100_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class BatchCase:
    """One case: its name (also of its folder), pictures and geometry file (None for DICOM)."""

    name: str
    views: tuple[Path, ...]
    geometry: Path | None

    def fingerprint(self, options: Mapping[str, Any]) -> str:
        """SHA-256 of everything the result depends on; unreadable files count as absent."""
        digest = hashlib.sha256(json.dumps(options, sort_keys=True).encode())
        for path in (*([self.geometry] if self.geometry else []), *self.views):
            try:
                content = hashlib.sha256(path.read_bytes()).digest()
            except OSError:
                content = b"absent"
            digest.update(path.name.encode("utf-8", "surrogateescape") + b"\0" + content)
        return digest.hexdigest()


def read_cases(table: Path) -> list[BatchCase]:
    """Read ``case,geom,view1,view2[,view3 ...]``; paths are relative to the table.

    ``geom`` may be empty where the views are DICOM XA.

    Raises
    ------
    UsageError
        One line with the line number and column. Whether the files are any good is found out
        case by case.
    """
    try:
        text = table.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError):
        raise UsageError(f"{table} cannot be read as a table (UTF-8, comma-separated)") from None
    reader = csv.DictReader(io.StringIO(text, newline=""), strict=True)
    try:
        lines = list(reader)
    except csv.Error as error:
        raise UsageError(f"{table.name}: line {reader.line_num}: {error}") from None
    columns = _view_columns(table, reader.fieldnames or [])
    if not lines or len(lines) > MOST_CASES:
        raise UsageError(f"{table.name}: {len(lines)} cases; 1 .. {MOST_CASES} are taken")
    cases: dict[str, BatchCase] = {}
    for number, line in enumerate(lines, start=2):
        case = _case(table, number, line, columns)
        if case.name.lower() in (name.lower() for name in cases):
            raise UsageError(f"{table.name}: line {number}: case {case.name!r} stands there twice")
        cases[case.name] = case
    return list(cases.values())


def _view_columns(table: Path, names: Any) -> list[str]:
    views = sorted(
        (name for name in names if _VIEW.fullmatch(name)), key=lambda name: int(name[4:])
    )
    for name in ("case", "geom"):
        if name not in names:
            raise UsageError(f"{table.name}: column {name!r} is missing")
    if views[:2] != ["view1", "view2"]:
        raise UsageError(f"{table.name}: columns 'view1' and 'view2' are missing")
    unknown = set(names) - {"case", "geom", *views}
    if unknown:
        raise UsageError(f"{table.name}: unknown column {sorted(unknown)[0]!r}")
    return views


def _case(table: Path, number: int, line: Mapping[Any, Any], columns: list[str]) -> BatchCase:
    where = f"{table.name}: line {number}"
    if None in line:
        raise UsageError(f"{where}: more fields than columns")
    name = (line["case"] or "").strip()
    if not _NAME.fullmatch(name) or name.lower() in _RESERVED:
        raise UsageError(
            f"{where}: case {name!r} must be letters, digits, '.', '_' or '-' (it names a folder)"
        )
    cells = [(line[column] or "").strip() for column in columns]
    while cells and not cells[-1]:
        cells.pop()
    if len(cells) < 2 or not all(cells):
        raise UsageError(f"{where}: two or more views, without a gap, are needed")
    geometry, folder = (line["geom"] or "").strip(), table.parent
    return BatchCase(
        name=name,
        views=tuple(folder / cell for cell in cells),
        geometry=folder / geometry if geometry else None,
    )
