"""Read a result folder back: the tree as ``gcar run`` wrote it."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from gcar_deploy.errors import UsageError
from gcar_deploy.files import read_bounded
from gcar_deploy.tree.tree import Branch, Tree

_MOST_BYTES = 2**26
_COLUMNS = ("branch", "x_mm", "y_mm", "z_mm", "radius_mm", "sigma_mm", "confidence")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Stored:
    """What a result folder holds: ``result.json``, and the tree of ``centerline.csv``."""

    summary: dict[str, Any]
    tree: Tree


def read_folder(folder: Path) -> Stored:
    """Read a result folder.

    Raises
    ------
    UsageError
        It is none, or ``centerline.csv`` is not as it was written.
    """
    summary = read_summary(folder)
    try:
        data = read_bounded(folder / "centerline.csv", _MOST_BYTES)
    except ValueError as error:
        raise UsageError(f"{folder / 'centerline.csv'} {error}") from None
    listed = summary.get("files", {}).get("centerline.csv", {})
    if hashlib.sha256(data).hexdigest() != listed.get("sha256"):
        raise UsageError(f"{folder / 'centerline.csv'} is not as it was written; run gcar again")
    try:
        tree = _tree(data.decode("ascii"), summary["tree"]["branches"])
    except (KeyError, ValueError, TypeError, IndexError):
        raise UsageError(f"{folder}: centerline.csv and result.json do not fit together") from None
    return Stored(summary=summary, tree=tree)


def read_summary(path: Path) -> dict[str, Any]:
    """Read the result.json of a folder, or the file itself.

    Raises
    ------
    UsageError
        There is none, or it is not of schema gcar-result/1.
    """
    file = path / "result.json" if path.is_dir() else path
    try:
        summary = json.loads(read_bounded(file, _MOST_BYTES).decode("utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError):
        raise UsageError(f"{file} is not a result.json") from None
    except ValueError as error:
        raise UsageError(f"{file} {error}") from None
    if not isinstance(summary, dict) or summary.get("schema") != "gcar-result/1":
        raise UsageError(f"{file} is not of schema gcar-result/1")
    return summary


def _tree(text: str, told: list[dict[str, Any]]) -> Tree:
    """Tree of the rows of centerline.csv, with the nodes of result.json."""
    rows = [[float(row[name] or "nan") for name in _COLUMNS]
            for row in csv.DictReader(io.StringIO(text))]  # fmt: skip
    table = np.array(rows).reshape(-1, len(_COLUMNS))
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
