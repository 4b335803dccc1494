"""What of a file is of another kind than its JSON Schema tells: types and counts alone.

jsonschema, which checks all of a schema, belongs to the tests; a reader wants to know that it may
go through what it was given. Keys that are missing are no misfit: earlier versions wrote fewer.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

_KINDS: Mapping[str, tuple[type, ...]] = {
    "object": (dict,), "array": (list,), "string": (str,), "boolean": (bool,),
    "number": (int, float), "integer": (int,), "null": (type(None),),
}  # fmt: skip


def misfit(found: Any, schema: Mapping[str, Any]) -> str | None:
    """JSON pointer of the first value that does not fit; None where all do.

    Parameters
    ----------
    found : what was read
    schema : of it; references go to its own ``$defs``
    """
    return next(_misfits(found, schema, "", schema.get("$defs", {})), None)


def _misfits(
    found: Any, schema: Mapping[str, Any], place: str, known: Mapping[str, Any]
) -> Iterator[str]:
    if not schema:  # nothing is told of it, however deep it is
        return
    if "$ref" in schema:
        schema = known[schema["$ref"].rpartition("/")[2]]
    kinds = schema.get("type", list(_KINDS))
    chosen = any(_is(found, kind) for kind in ([kinds] if isinstance(kinds, str) else kinds))
    ways = schema.get("oneOf")
    if not chosen or (ways and not any(_fits(found, one, known) for one in ways)):
        yield place or "/"
    elif isinstance(found, dict):
        own, more = schema.get("properties", {}), schema.get("additionalProperties")
        for key, value in found.items():
            inner = own.get(key, more if isinstance(more, dict) else {})
            yield from _misfits(value, inner, f"{place}/{key}", known)
    elif isinstance(found, list):
        if not schema.get("minItems", 0) <= len(found) <= schema.get("maxItems", len(found)):
            yield place or "/"
        for number, value in enumerate(found):
            yield from _misfits(value, schema.get("items", {}), f"{place}/{number}", known)


def _fits(found: Any, schema: Mapping[str, Any], known: Mapping[str, Any]) -> bool:
    return next(_misfits(found, schema, "", known), None) is None


def _is(found: Any, kind: str) -> bool:
    if isinstance(found, bool):  # which Python takes for a number
        return kind == "boolean"
    if kind == "integer" and isinstance(found, float):  # 1.0 is an integer in JSON
        return found.is_integer()
    return isinstance(found, _KINDS[kind])
