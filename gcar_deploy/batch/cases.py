"""The table of cases: one line a case, read and judged before anything runs."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gcar_deploy.config import DicomLimits, Landmark
from gcar_deploy.engine_choice import EngineChoice
from gcar_deploy.errors import UsageError
from gcar_deploy.files import digest_of, text_of
from gcar_deploy.geometry.fields import quote
from gcar_deploy.inputs.order import Order, check_view_numbers, load_order
from gcar_deploy.inputs.words import VIEW_NUMBER, parse_frames, parse_landmark

#: names become folders
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_VIEW = re.compile(r"view([1-9][0-9]?)")
_MASK = re.compile(rf"mask({VIEW_NUMBER})")
#: what a batch itself puts beside its cases
_RESERVED = re.compile(
    r"rows|batch\.json|summary\.(csv|html)(\.partial|\.\d+\.tmp)?", re.IGNORECASE
)
MOST_CASES = 100_000
#: a run would not read more of a file or folder either
_LIMITS = DicomLimits()


@dataclasses.dataclass(frozen=True)
class BatchCase:
    """One case: its name, also of its folder, and its order, which has no folder yet."""

    name: str
    order: Order

    def fingerprint(self, engine: EngineChoice) -> str:
        """SHA-256 of everything the result depends on; unreadable files count as absent."""
        order = self.order.with_files(lambda _, path: Path(path.name))
        # Of an engine only its models: threads change no byte.
        digest = hashlib.sha256(json.dumps(order.to_dict(), sort_keys=True, default=str).encode())
        for name, path in {**self.order.files, **engine.files}.items():
            content = digest_of(path, _LIMITS.max_bytes, _LIMITS.max_frames)
            digest.update(name.encode() + b"\0" + content)
        return digest.hexdigest()


def read_cases(table: Path, like: Order) -> list[BatchCase]:
    """Read ``case,geom,view1,view2[,view3 ...]``; paths are relative to the table.

    ``geom`` may be empty where the views are DICOM XA. Columns ``mask1`` ... and those of
    ``COLUMNS`` say more of a case; an empty field leaves what ``like`` says. Column ``order``
    names an order file, as ``gcar open`` keeps it: pictures, geometry and corrections are its own
    where the line leaves them empty.

    Parameters
    ----------
    table : file
    like : Order, what holds for every case

    Raises
    ------
    UsageError
        One line with the line number and column. Whether the files are any good is found out
        case by case.
    """
    try:
        text = text_of(table.read_bytes())
    except (OSError, ValueError):
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
        case = _case(table, number, line, columns, like)
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
    twice = [name for name in names if list(names).count(name) > 1]
    if twice:
        raise UsageError(f"{table.name}: column {twice[0]!r} stands there twice")
    unknown = {name for name in names if not _MASK.fullmatch(name)}
    unknown -= {"case", "geom", "order", *views, *COLUMNS}
    if unknown:
        raise UsageError(f"{table.name}: unknown column {quote(sorted(unknown)[0])}")
    return views


def _case(
    table: Path, number: int, line: Mapping[Any, Any], columns: list[str], like: Order
) -> BatchCase:
    where = f"{table.name}: line {number}"
    if None in line:
        raise UsageError(f"{where}: more fields than columns")
    told = {name: (text or "").strip() for name, text in line.items()}
    name = told["case"]
    if not _NAME.fullmatch(name):
        raise UsageError(
            f"{where}: case {name!r} must be letters, digits, '.', '_' or '-' (it names a folder)"
        )
    if _RESERVED.fullmatch(name):
        raise UsageError(f"{where}: case {name!r} has the name of a file of the batch itself")
    cells = [told[column] for column in columns]
    while cells and not cells[-1]:
        cells.pop()
    whole = bool(told.get("order")) and not cells
    if not whole and (len(cells) < 2 or not all(cells)):
        raise UsageError(f"{where}: two or more views, without a gap, are needed")
    try:
        base = _like(like, table.parent / told["order"]) if told.get("order") else like
        masks = {int(k[4:]): Path(v) for k, v in told.items() if _MASK.fullmatch(k) and v}
        order = dataclasses.replace(
            base,
            views=base.views if whole else tuple(Path(cell) for cell in cells),
            geometry=Path(told["geom"]) if told["geom"] else base.geometry,
            masks={**base.masks, **masks},
            **{COLUMNS[k][0]: COLUMNS[k][1](v) for k, v in told.items() if k in COLUMNS and v},
        )
        check_view_numbers(order)
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from None
    return BatchCase(name, order.relative_to(table.parent))


def _like(like: Order, file: Path) -> Order:
    """Return an order file's order, with what holds for every case over it, without its folder."""
    own = load_order(file).with_files(lambda _, path: path.absolute())
    plain = Order()
    said = {
        field.name: value
        for field in dataclasses.fields(Order)
        if (value := getattr(like, field.name)) != getattr(plain, field.name)
    }
    return dataclasses.replace(own, out=None, force=False, **said)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"{text[:40]!r} must be a number") from None


def _landmarks(text: str) -> tuple[Landmark, ...]:
    return tuple(parse_landmark(word) for word in text.split())


#: column that says more of a case -> key of its order, reader of its text
COLUMNS: Mapping[str, tuple[str, Callable[[str], Any]]] = {
    "frame": ("frames", parse_frames),
    "landmarks": ("landmarks", _landmarks),
    "pixel_spacing_mm": ("pixel_spacing_mm", _number),
    "sod_mm": ("sod_mm", _number),
    "deadline_s": ("deadline_s", _number),
    **{key: (key, str) for key in ("segmenter", "predictor", "refiner", "pose")},
}
