"""An order: which pictures, which geometry, where the result goes; read from JSON values."""

from __future__ import annotations

import dataclasses
import re
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gcar_deploy.engine import Engine
from gcar_deploy.errors import GeometryError, RefusedError, UsageError
from gcar_deploy.geometry.fields import check_object, number
from gcar_deploy.worker.folder import AllowedFolder

#: pictures of one order
MOST_VIEWS = 16
KEYS = ("views", "geometry", "out", "force", "strict", "deadline_s")
_SUFFIX = re.compile(r"\.[A-Za-z0-9]{1,8}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Order:
    """One reconstruction to be done.

    Attributes
    ----------
    views : picture files, in the order of the geometry's views
    geometry : content of ``geom.json``, or the file; None where DICOM headers tell it
    out : result folder asked for; None keeps it beside the job
    force : replace an existing result folder
    strict : take a degraded result for a refusal
    deadline_s : seconds, or None
    scratch : private folder that goes with the job, or None
    """

    views: tuple[Path, ...]
    geometry: Mapping[str, Any] | Path | None
    out: Path | None = None
    force: bool = False
    strict: bool = False
    deadline_s: float | None = None
    scratch: Path | None = None


def parse_order(values: Any, folder: AllowedFolder | None) -> Order:
    """Read an order that names files.

    Parameters
    ----------
    values : JSON object with ``views`` and ``geometry`` (unless the views are DICOM), and at
        will ``out``, ``force``, ``strict``, ``deadline_s``
    folder : every file must lie in it, and is copied first; None takes any path as it is

    Raises
    ------
    UsageError
        A key is missing, unknown or of the wrong kind, or a path is not allowed.
    """
    values = check_keys(values)
    names, geometry = values.get("views"), values.get("geometry")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise UsageError("views must be a list of file names")
    if not 2 <= len(names) <= MOST_VIEWS:
        raise UsageError(f"views has {len(names)} entries; 2 .. {MOST_VIEWS} are taken")
    if not isinstance(geometry, (str, dict, type(None))):
        raise UsageError("geometry must be the content of a geom.json, or a file name")
    common = common_fields(values, folder)
    if folder is None:
        place = Path(geometry) if isinstance(geometry, str) else geometry
        return Order(views=tuple(Path(name) for name in names), geometry=place, **common)
    scratch = new_scratch()
    try:
        views = tuple(
            folder.copy(name, scratch / f"view{k}{suffix_of(name)}")
            for k, name in enumerate(names, start=1)
        )
        if isinstance(geometry, str):
            geometry = folder.copy(geometry, scratch / "geom.json")
    except BaseException:
        shutil.rmtree(scratch, ignore_errors=True)
        raise
    return Order(views=views, geometry=geometry, scratch=scratch, **common)


def check_keys(values: Any) -> dict[str, Any]:
    """Return ``values`` if it is an object with known keys alone.

    Raises
    ------
    UsageError
        With a suggestion for a misspelt key.
    """
    try:
        check_object("order", values, KEYS)
    except GeometryError as error:
        raise UsageError(str(error)) from None
    checked: dict[str, Any] = values
    return checked


def common_fields(values: Mapping[str, Any], folder: AllowedFolder | None) -> dict[str, Any]:
    """Read ``out``, ``force``, ``strict`` and ``deadline_s``."""
    found: dict[str, Any] = {}
    for key in ("force", "strict"):
        if not isinstance(values.get(key, False), bool):
            raise UsageError(f"{key} = {values[key]!r} must be true or false")
        found[key] = values.get(key, False)
    deadline = values.get("deadline_s")
    if deadline is not None:
        try:
            deadline = number("deadline_s", deadline)
        except GeometryError as error:
            raise UsageError(str(error)) from None
        if not deadline > 0:
            raise UsageError(f"deadline_s = {deadline:g} must be above 0")
    out = values.get("out")
    if out is not None and not isinstance(out, str):
        raise UsageError("out must be the name of a folder")
    found["deadline_s"] = deadline
    found["out"] = None if out is None else Path(out) if folder is None else folder.target(out)
    return found


def suffix_of(name: str) -> str:
    """Suffix of a file name, from which its format is told; empty if it is an odd one."""
    suffix = Path(name).suffix
    return suffix.lower() if _SUFFIX.fullmatch(suffix) else ""


def new_scratch() -> Path:
    """Make a folder that only this user may read."""
    return Path(tempfile.mkdtemp(prefix="gcar-worker-"))


def do_order(
    engine: Engine,
    order: Order,
    on_progress: Callable[[str, float], None],
    cancel: Callable[[], bool],
    *,
    limit_s: float | None = None,
) -> tuple[dict[str, Any], Path]:
    """Reconstruct and write the result folder.

    Parameters
    ----------
    limit_s : the longest deadline that is granted

    Returns
    -------
    content of ``result.json`` without its list of files, the folder

    Raises
    ------
    GcarError
        As ``gcar run``.
    """
    out = order.out
    if out is None:
        if order.scratch is None:
            raise UsageError("out is missing: name the folder for the result")
        out = order.scratch / "result"
    else:
        from gcar_deploy.output.folder import check_target

        check_target(out, force=order.force, inputs=order.views)
    limits = [limit for limit in (order.deadline_s, limit_s) if limit is not None]
    result = engine.reconstruct(
        list(order.views),
        order.geometry,
        on_progress=on_progress,
        deadline_s=min(limits, default=None),
        cancel=cancel,
    )
    if order.strict and result.status != "ok":
        raise RefusedError(f"degraded, and strict was asked for: {result.quality.sentence}")
    result.save(out, force=order.force)
    return result.summary(), out
