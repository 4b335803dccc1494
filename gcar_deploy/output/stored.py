"""Read a result folder back: the tree as ``gcar run`` wrote it."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import hashlib
import io
import json
from collections.abc import Callable, Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from gcar_deploy.errors import UsageError
from gcar_deploy.files import is_file, is_folder, read_bounded
from gcar_deploy.measure import Sections
from gcar_deploy.output.misfit import misfit
from gcar_deploy.output.tables import SECTION_COLUMNS
from gcar_deploy.tree.tree import Branch, Tree
from gcar_deploy.types import Array

_MOST_BYTES, _MOST_LISTED_BYTES = 2**26, 2**30
_Parsed = TypeVar("_Parsed")
_COLUMNS = ("branch", "x_mm", "y_mm", "z_mm", "radius_mm", "sigma_mm", "confidence")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Stored:
    """What a result folder holds.

    Attributes
    ----------
    summary : ``result.json``
    tree : of ``centerline.csv``
    lumen : tree with a point at each section, and its sections, of ``diameters.csv``; None where
        there is no such file
    """

    summary: dict[str, Any]
    tree: Tree
    lumen: tuple[Tree, tuple[Sections, ...]] | None


def read_folder(folder: Path) -> Stored:
    """Read a result folder.

    Raises
    ------
    UsageError
        It is none, or a table is not as it was written.
    """
    summary = read_summary(folder)
    tree = _parsed(folder, "centerline.csv", summary, _tree)
    lumen = None
    # Folders of versions before have none.
    if "diameters.csv" in summary.get("files", {}):
        lumen = _parsed(folder, "diameters.csv", summary, _lumen)
    return Stored(summary=summary, tree=tree, lumen=lumen)


def _parsed(
    folder: Path,
    name: str,
    summary: dict[str, Any],
    parse: Callable[[str, list[dict[str, Any]]], _Parsed],
) -> _Parsed:
    """Table of a folder, if it is as it was written and fits ``result.json``."""
    data = read_listed(folder, name, summary)
    try:
        return parse(data.decode("ascii"), summary["tree"]["branches"])
    except (KeyError, ValueError, TypeError, IndexError):
        raise UsageError(f"{folder}: {name} and result.json do not fit together") from None


def read_listed(folder: Path, name: str, summary: dict[str, Any]) -> bytes:
    """Bytes of a file of a result folder, if they are those that were written.

    Raises
    ------
    UsageError
        It is missing, or another one than ``summary`` lists.
    """
    file = folder / Path(name).name
    try:
        data = read_bounded(file, _MOST_LISTED_BYTES)
    except ValueError as error:
        raise UsageError(f"{file} {error}") from None
    listed = summary.get("files", {}).get(name, {})
    if hashlib.sha256(data).hexdigest() != listed.get("sha256"):
        raise UsageError(f"{file} is not as it was written; run gcar again")
    return data


def altered_files(folder: Path, summary: dict[str, Any]) -> list[str]:
    """Names of the listed files that are missing or have another SHA-256."""
    if not is_folder(folder):
        return []
    out = []
    for name, entry in summary.get("files", {}).items():
        file = folder / Path(name).name
        if not is_file(file) or hashlib.sha256(file.read_bytes()).hexdigest() != entry["sha256"]:
            out.append(name)
    return out


def read_summary(path: Path) -> dict[str, Any]:
    """Read the result.json of a folder, or the file itself.

    Raises
    ------
    UsageError
        There is none, it is not of schema gcar-result/1, or a value is of another kind than there.
    """
    file = _summary_file(path)
    try:
        text = read_bounded(file, _MOST_BYTES).decode("utf-8")
        summary = json.loads(text, parse_constant=_no_number)
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError):
        raise UsageError(f"{file} is not a result.json") from None
    except ValueError as error:
        raise UsageError(f"{file} {error}") from None
    if not isinstance(summary, dict) or summary.get("schema") != "gcar-result/1":
        raise UsageError(f"{file} is not of schema gcar-result/1")
    schema = resources.files("gcar_deploy.output").joinpath("result.schema.json")
    place = misfit(summary, json.loads(schema.read_text(encoding="utf-8")))
    if place is not None:
        raise UsageError(f"{file} is not as gcar wrote it: {place} is of another kind")
    return summary


@contextlib.contextmanager
def as_written(path: Path) -> Iterator[None]:
    """Say of what is read out of a summary that it is not there; ``path`` as in ``read_summary``.

    Raises
    ------
    UsageError
        A key is missing, or a value is null that a result always has.
    """
    try:
        yield
    except KeyError as error:
        told = f"{error} is missing"
    except (TypeError, AttributeError, IndexError):
        told = "a value is of another kind"
    else:
        return
    raise UsageError(f"{_summary_file(path)} is not as gcar wrote it: {told}")


def _summary_file(path: Path) -> Path:
    return path / "result.json" if is_folder(path) else path


def _no_number(text: str) -> None:
    raise ValueError(f"is no JSON: it holds {text}")


def _tree(text: str, told: list[dict[str, Any]]) -> Tree:
    """Tree of the rows of centerline.csv, with the nodes of result.json."""
    table = _table(text, _COLUMNS)
    branches = []
    nodes = np.zeros((1 + max((max(b["start"], b["end"]) for b in told), default=-1), 3))
    for number, branch in enumerate(told, start=1):
        own = table[table[:, 0] == number]
        if len(own) < 2 or not np.isfinite(own[:, :5]).all() or (own[:, 4] <= 0).any():
            raise ValueError(f"branch {number}")
        start, end = int(branch["start"]), int(branch["end"])
        nodes[start], nodes[end] = own[0, 1:4], own[-1, 1:4]
        branches.append(
            Branch(
                points_mm=own[:, 1:4], radius_mm=own[:, 4], sigma_mm=own[:, 5],
                confidence=own[:, 6], start=start, end=end,
            )
        )  # fmt: skip
    if sum(len(branch) for branch in branches) != len(table):
        raise ValueError("more branches than told")
    return Tree(nodes_mm=nodes, branches=tuple(branches))


def _lumen(text: str, told: list[dict[str, Any]]) -> tuple[Tree, tuple[Sections, ...]]:
    """Lumen of the rows of diameters.csv, with the nodes of result.json."""
    table = _table(text, ("branch", *SECTION_COLUMNS))
    nodes = np.zeros((1 + max((max(b["start"], b["end"]) for b in told), default=-1), 3))
    branches, sections = [], []
    for number, branch in enumerate(told, start=1):
        own = table[table[:, 0] == number]
        if len(own) < 2 or not np.isfinite(own[:, 1:6]).all() or (own[:, 5] <= 0).any():
            raise ValueError(f"branch {number}")
        start, end = int(branch["start"]), int(branch["end"])
        nodes[start], nodes[end] = own[0, 2:5], own[-1, 2:5]
        branches.append(
            Branch(
                points_mm=own[:, 2:5], radius_mm=0.5 * own[:, 5],
                sigma_mm=np.full(len(own), np.nan), confidence=np.ones(len(own)),
                start=start, end=end,
            )
        )  # fmt: skip
        blank = np.zeros((0, len(own)))
        sections.append(
            Sections(
                arc_mm=branches[-1].arc_mm, diameter_mm=own[:, 5], sigma_mm=own[:, 6],
                measured=own[:, 8] > 0, width_mm=blank, overlapped=blank.astype(bool),
            )
        )  # fmt: skip
    if sum(len(branch) for branch in branches) != len(table):
        raise ValueError("more branches than told")
    return Tree(nodes_mm=nodes, branches=tuple(branches)), tuple(sections)


def _table(text: str, columns: Sequence[str]) -> Array:
    """(rows, columns) of a CSV; empty fields are NaN."""
    rows = [
        [float(row[name] or "nan") for name in columns] for row in csv.DictReader(io.StringIO(text))
    ]
    return np.array(rows).reshape(-1, len(columns))
