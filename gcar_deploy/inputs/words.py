"""Parts of an order as people write them, in options and in tables."""

from __future__ import annotations

import math
import re
from pathlib import Path

from gcar_deploy.config import Landmark, LesionBorders
from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.fields import MOST_VIEWS

#: pattern of the number of a view
VIEW_NUMBER = "|".join(str(k) for k in range(1, MOST_VIEWS + 1))
_LESION = re.compile(rf"({VIEW_NUMBER}):([^:]+):([^:]+)")
_MASK = re.compile(rf"({VIEW_NUMBER}):(.+)", re.DOTALL)


def parse_frames(text: str) -> tuple[int | None, ...]:
    """Read ``auto``, a number from 1, or one of these for each run, as in ``7,auto``.

    Raises
    ------
    UsageError
    """
    frames: list[int | None] = []
    for word in (part.strip() for part in text.split(",")):
        if word != "auto" and not (word.isascii() and word.isdigit() and len(word) < 7):
            raise UsageError(f"frame {text[:40]!r} must be auto, a number, or one for each file")
        frames.append(None if word == "auto" else int(word))
    return tuple(frames)


def parse_landmark(text: str) -> Landmark:
    """Read ``C1,R1:C2,R2[:C3,R3 ...]``, with - where a view does not show the point.

    Raises
    ------
    UsageError
    """
    out: list[tuple[float, float] | None] = []
    for part in text.split(":"):
        point = None if part.strip() == "-" else _point(part)
        if point is None and part.strip() != "-":
            raise UsageError(
                f"landmark {text[:60]!r} must be column,row:column,row with one point per view"
            )
        out.append(point)
    return tuple(out)


def parse_lesion(text: str) -> LesionBorders:
    """Read ``N:C1,R1:C2,R2``: proximal and distal border of a lesion in view N.

    Raises
    ------
    UsageError
    """
    found = _LESION.fullmatch(text)
    ends = [] if found is None else [_point(found[2]), _point(found[3])]
    if found is None or ends[0] is None or ends[1] is None:
        raise UsageError(
            f"lesion {text[:60]!r} must be N:column,row:column,row, N the number of the view"
        )
    return LesionBorders(view=int(found[1]), proximal=ends[0], distal=ends[1])


def _point(text: str) -> tuple[float, float] | None:
    """(column, row) of ``C,R``; None where it is none."""
    try:
        column, row = (float(word) for word in text.split(","))
    except ValueError:
        return None
    return (column, row) if math.isfinite(column) and math.isfinite(row) else None


def parse_mask(text: str) -> tuple[int, Path]:
    """Read ``N:FILE``, the mask of view N.

    Raises
    ------
    UsageError
    """
    found = _MASK.fullmatch(text)
    if found is None:
        raise UsageError(
            f"mask {text[:60]!r} must be N:FILE, N the number of the view (1 .. {MOST_VIEWS})"
        )
    return int(found[1]), Path(found[2])
