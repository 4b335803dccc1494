"""Checked fields of a JSON object: every refusal is one short line, never a traceback.

``json`` alone accepts NaN, repeated keys, ``true`` for a number and 1e999; none of these may
reach a geometry.
"""

from __future__ import annotations

import difflib
import json
import math
from typing import Any

from gcar_deploy.errors import GeometryError

MAX_BYTES = 64 * 1024
#: views of one scene, pictures of one order
LEAST_VIEWS, MOST_VIEWS = 2, 16
#: a wrong value is quoted up to this many characters
MAX_QUOTE = 80


def quote(value: Any) -> str:
    """``repr`` of a value, short enough for one line of an error message."""
    text = repr(value)
    return text if len(text) <= MAX_QUOTE else text[:MAX_QUOTE] + " ..."


class _NoNumber(str):
    """NaN or Infinity, until the key that it stands under is known."""


def read_json(text: str, max_bytes: int = MAX_BYTES) -> Any:
    """Parse JSON strictly: no NaN, Infinity or repeated keys, at most ``max_bytes``.

    Raises
    ------
    GeometryError
    """

    def refuse(value: Any, where: str = "") -> None:
        waiting = [value]
        while waiting:
            one = waiting.pop()
            if isinstance(one, list):
                waiting += one
            elif isinstance(one, _NoNumber):
                raise GeometryError(f"{where}{one} is not a number in JSON")

    def pairs(items: list[tuple[str, Any]]) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for key, value in items:
            if key in out:
                raise GeometryError(f"key {quote(key)} stands twice")
            refuse(value, f"{quote(key)[1:-1]}: ")
            out[key] = value
        return out

    if len(text.encode("utf-8", "replace")) > max_bytes:
        raise GeometryError(f"larger than {max_bytes // 1024} KiB")
    try:
        found = json.loads(text, parse_constant=_NoNumber, object_pairs_hook=pairs)
        refuse(found)
        return found
    except json.JSONDecodeError as error:
        raise GeometryError(f"not JSON: {error.msg} at line {error.lineno}") from None
    except RecursionError:
        raise GeometryError("not a scene: nested too deeply") from None
    except ValueError:
        raise GeometryError("a number has too many digits") from None


def check_object(what: str, value: Any, known: tuple[str, ...]) -> None:
    """Refuse what is no JSON object, and keys that are not ``known``, with the nearest one."""
    if not isinstance(value, dict):
        raise GeometryError(f"{what} must be a JSON object")
    for key in value:
        if key not in known:
            close = difflib.get_close_matches(key[:MAX_QUOTE], known, n=1, cutoff=0.5)
            hint = f"; did you mean {close[0]!r}?" if close else f"; known: {', '.join(known)}"
            raise GeometryError(f"unknown key {quote(key)}{hint}")


def check_choice(key: str, value: Any, allowed: tuple[str, ...]) -> None:
    """Refuse a value that is none of ``allowed``."""
    if value not in allowed:
        raise GeometryError(f"{key} = {quote(value)} must be one of {', '.join(allowed)}")


def number(key: str, value: Any) -> float:
    """Return a finite number; booleans and text are none."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise GeometryError(f"{key} = {quote(value)} must be a number")
    try:
        found = float(value)
    except OverflowError:
        found = math.inf
    if not math.isfinite(found):
        raise GeometryError(f"{key} is not a finite number")
    return found


def whole(key: str, value: Any) -> int:
    """Return a whole number, which may be written as 512.0."""
    found = number(key, value)
    if found != int(found):
        raise GeometryError(f"{key} = {quote(value)} must be a whole number")
    return int(found)


def numbers(key: str, value: Any, count: int, limit: float = math.inf) -> list[float]:
    """Return ``count`` finite numbers within +- ``limit``; the key's ending names the unit."""
    if not isinstance(value, list) or len(value) != count:
        raise GeometryError(f"{key} = {quote(value)} must be {count} numbers")
    out = [number(key, x) for x in value]
    if any(abs(x) > limit for x in out):
        unit = {"mm": " mm", "px": " px"}.get(key[-2:], "")
        raise GeometryError(f"{key} = {quote(value)} is outside -{limit:g} .. {limit:g}{unit}")
    return out
