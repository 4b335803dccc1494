"""What each option may be: ranges stand beside the defaults, and are checked in one place.

A field's range is part of its type, ``lattices: Annotated[int, Range(1, 4)] = 2``. Outside it a run
would fail somewhere within, or take memory without end; inside it any value gives a result, if
not a good one.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import numbers
import types
import typing
from typing import Annotated, Any, Literal, TypeAlias

from gcar_deploy.errors import UsageError


@dataclasses.dataclass(frozen=True)
class Range:
    """From the least to the most allowed value, both included; ``many`` values at least."""

    least: float
    most: float
    many: int = 0

    def __str__(self) -> str:
        """Words for a message."""
        each = f"{self.least:,.10g} .. {self.most:,.10g}"
        return f"{self.many} or more values of {each}" if self.many else each


Share: TypeAlias = Annotated[float, Range(0, 1)]
#: lengths that are divided by, or that arrays are as long as the inverse of
Step: TypeAlias = Annotated[float, Range(0.01, 1e3)]
Length: TypeAlias = Annotated[float, Range(0, 1e6)]
#: standard deviations and scales: divided by
Scale: TypeAlias = Annotated[float, Range(1e-6, 1e9)]
#: steps, rounds, passes: how often something is done
Count: TypeAlias = Annotated[int, Range(0, 1_000_000)]
#: sizes of files, pictures, graphs
Size: TypeAlias = Annotated[int, Range(0, 2**40)]
Angle: TypeAlias = Annotated[float, Range(0, 180)]


def check_options(options: Any, name: str = "") -> None:
    """Refuse options that are of another type than they should be, or out of range.

    Parameters
    ----------
    options : a dataclass of options, for instance ``RunOptions``
    name : put in front of its fields' names

    Raises
    ------
    UsageError
        One line with the field, its value and what it may be; or with what ``contradiction()`` of
        the dataclass says of fields that do not fit together.
    """
    kind: Any = type(options)
    for field, hint in _hints(kind).items():
        _check(f"{name}{field}", getattr(options, field), hint)
    wrong = options.contradiction() if hasattr(options, "contradiction") else ""
    if wrong:
        raise UsageError(f"option {name}{wrong}")


def check_field(kind: type, field: str, value: Any) -> None:
    """Refuse what ``kind``, a dataclass of options, would refuse as its ``field``.

    Raises
    ------
    UsageError
        One line with the field, its value and what it may be.
    """
    _check(field, value, _hints(kind)[field])


@functools.cache
def _hints(kind: Any) -> dict[str, Any]:
    known = typing.get_type_hints(kind, include_extras=True)
    return {field.name: known[field.name] for field in dataclasses.fields(kind)}


def _check(key: str, value: Any, hint: Any, rule: Range | None = None) -> None:
    if typing.get_origin(hint) is Annotated:
        hint, rule = typing.get_args(hint)
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        if value is None:
            return
        (hint,) = (part for part in typing.get_args(hint) if part is not types.NoneType)
    if typing.get_origin(hint) is Annotated:
        hint, rule = typing.get_args(hint)
    if typing.get_origin(hint) is Literal:
        check_choice(f"option {key}", value, typing.get_args(hint))
    elif dataclasses.is_dataclass(hint):
        if not isinstance(value, typing.cast(type, hint)):
            raise _refusal(f"option {key}", value, f"{typing.cast(type, hint).__name__}(...)")
        check_options(value, f"{key}.")
    elif typing.get_origin(hint) is tuple:
        parts = typing.get_args(hint)
        short = not isinstance(value, tuple) or len(value) < (rule.many if rule else 0)
        if short or (parts[-1] is not Ellipsis and len(value) != len(parts)):
            raise _refusal(f"option {key}", value, f"a tuple of {rule}" if rule else "a tuple")
        for one in value:
            _check(key, one, parts[0], rule)
    elif hint in (int, float):
        check_number(f"option {key}", value, hint, rule)
    elif not isinstance(value, hint):
        raise _refusal(f"option {key}", value, {bool: "True or False", str: "text"}[hint])


def check_number(key: str, value: Any, hint: type, rule: Range | None) -> None:
    """Refuse what is no finite number of the type ``hint`` (int or float) within ``rule``.

    Raises
    ------
    UsageError
        One line that begins with ``key``.
    """
    kind, words = (
        (numbers.Integral, "a whole number") if hint is int else (numbers.Real, "a number")
    )
    what = f"{words}, {dataclasses.replace(rule, many=0)}" if rule else words
    if not isinstance(value, kind) or isinstance(value, bool) or not _finite(value):
        raise _refusal(key, value, what)
    if rule is not None and not rule.least <= float(value) <= rule.most:
        raise _refusal(key, value, what)


def _finite(value: Any) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number that no float holds
        return False


def check_choice(key: str, value: Any, known: tuple[str, ...]) -> None:
    """Refuse what is none of the ``known`` words.

    Raises
    ------
    UsageError
        One line that begins with ``key``.
    """
    if not isinstance(value, str) or value not in known:
        raise _refusal(key, value, f"one of {', '.join(known)}")


def _refusal(key: str, value: Any, what: str) -> UsageError:
    return UsageError(f"{key} = {' '.join(repr(value).split())[:60]} must be {what}")
