"""How grave a finding is, so that the one sentence of a result is never its smallest trouble.

A plain sentence may mean the whole tree: views that contradict each other, a place, a scale or a
depth that is wrong. It is what a finding is where nobody says otherwise.
"""

from __future__ import annotations

from collections.abc import Iterable


class Part(str):
    """A finding that leaves the tree in its place and doubts parts of it."""

    __slots__ = ()


class Remark(str):
    """A finding to look at, of a line or an end; the tree may well be right."""

    __slots__ = ()


def gravest_first(findings: Iterable[str]) -> tuple[str, ...]:
    """Return the findings as plain sentences by their gravity; equal ones stay in their order."""
    ranked = sorted(findings, key=lambda said: (isinstance(said, Remark), isinstance(said, Part)))
    return tuple(map(str, ranked))
