"""What a person drew in the pictures: strokes that erase or paint vessel, regions of interest."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.fields import check_choice, check_object, number, quote

if TYPE_CHECKING:
    from gcar_deploy.types import Array, Mask

DOES = ("erase", "paint")
_DIGEST = re.compile(r"[0-9a-f]{64}")
_KEYS = ("do", "width_px", "points")
#: points of one stroke, strokes of one view
MOST_POINTS, MOST_STROKES = 2000, 500
_MOST_WIDTH_PX = 400.0
#: no picture is larger, and a stroke may leave it by as much
_FARTHEST_PX = 2.0e4
#: (column, row)
Place: TypeAlias = tuple[float, float]
_SHIFT = 4


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stroke:
    """A line of some width, or a filled region.

    Attributes
    ----------
    do : ``erase`` (no vessel here) or ``paint`` (vessel here)
    points : (column, row) along the line, or corners of the region
    width_px : width of the line; None for a region
    """

    do: str
    points: tuple[Place, ...]
    width_px: float | None = None

    def meets(self, shape: tuple[int, ...]) -> bool:
        """Whether any of it lies in a picture of (rows, cols)."""
        if any(0 <= c <= shape[1] - 1 and 0 <= r <= shape[0] - 1 for c, r in self.points):
            return True
        marks = Drawn(strokes=(self,)).marks(shape)
        return marks is not None and bool(marks[0].any() or marks[1].any())

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values; see ``parse_edits``."""
        width = {} if self.width_px is None else {"width_px": self.width_px}
        return {"do": self.do, **width, "points": [list(point) for point in self.points]}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drawn:
    """All that was drawn in one view; strokes count in their order, the last one wins.

    ``on``: SHA-256 of the file that it, and every mark, was drawn on; empty where nobody told.
    """

    strokes: tuple[Stroke, ...] = ()
    region: tuple[Place, ...] = ()
    on: str = ""

    def inside(self, shape: tuple[int, ...]) -> Mask | None:
        """(rows, cols) bool, where the view is to be looked at; None for everywhere."""
        import numpy as np

        if not self.region:
            return None
        canvas = np.zeros(shape, np.uint8)
        _fill(canvas, self.region, 1)
        return canvas > 0

    def marks(self, shape: tuple[int, ...]) -> tuple[Mask, Mask] | None:
        """(rows, cols) bool what is erased and what is painted; None where nothing is."""
        import numpy as np

        if not self.strokes:
            return None
        canvas = np.zeros(shape, np.uint8)
        for stroke in self.strokes:
            value = 1 + DOES.index(stroke.do)
            if stroke.width_px is None:
                _fill(canvas, stroke.points, value)
            else:
                _brush(canvas, stroke.points, stroke.width_px, value)
        return canvas == 1, canvas == 2


def parse_edits(key: str, value: Any) -> dict[int, tuple[Stroke, ...]]:
    """Read ``{"1": [{"do": "erase", "width_px": 9, "points": [[c, r], ...]}, ...], ...}``.

    Raises
    ------
    UsageError, GeometryError
        One line with key and value.
    """
    return {k: _strokes(f"{key}.{k}", one) for k, one in by_view(key, value, "strokes").items()}


def parse_regions(key: str, value: Any) -> dict[int, tuple[Place, ...]]:
    """Read ``{"1": [[c, r], [c, r], [c, r], ...], ...}``: corners of what is looked at.

    Raises
    ------
    UsageError, GeometryError
    """
    return {k: _places(f"{key}.{k}", one, 3) for k, one in by_view(key, value, "corners").items()}


def parse_digests(key: str, value: Any) -> dict[int, str]:
    """Read ``{"1": SHA-256, ...}``.

    Raises
    ------
    UsageError
    """
    found = by_view(key, value, "SHA-256")
    for k, digest in found.items():
        if not isinstance(digest, str) or not _DIGEST.fullmatch(digest):
            raise UsageError(f"{key}.{k} = {quote(digest)} must be 64 digits 0 .. f")
    return found


def by_view(key: str, value: Any, of: str) -> dict[int, Any]:
    """Return an object with the numbers of views as keys.

    Raises
    ------
    UsageError
    """
    plain = isinstance(value, dict) and all(
        k.isascii() and k.isdigit() and len(k) < 3 and str(int(k)) == k for k in value
    )
    if not plain:
        raise UsageError(f"{key} = {quote(value)} must be an object: number of the view -> {of}")
    return {int(k): one for k, one in value.items()}


def drawn_by_view(
    edits: Mapping[int, tuple[Stroke, ...]],
    regions: Mapping[int, tuple[Place, ...]],
    drawn_on: Mapping[int, str],
) -> dict[int, Drawn]:
    """Return what was drawn in each view that was drawn in, or may have been."""
    return {
        k: Drawn(strokes=edits.get(k, ()), region=regions.get(k, ()), on=drawn_on.get(k, ""))
        for k in sorted({*edits, *regions, *drawn_on})
    }


def _strokes(key: str, value: Any) -> tuple[Stroke, ...]:
    if not isinstance(value, list) or len(value) > MOST_STROKES:
        raise UsageError(f"{key} must be a list of at most {MOST_STROKES} strokes")
    return tuple(_stroke(f"{key}[{k}]", one) for k, one in enumerate(value))


def _stroke(key: str, value: Any) -> Stroke:
    check_object(key, value, _KEYS)
    check_choice(f"{key}.do", value.get("do"), DOES)
    width = value.get("width_px")
    if width is not None:
        width = number(f"{key}.width_px", width)
        if not 1 <= width <= _MOST_WIDTH_PX:
            raise UsageError(f"{key}.width_px = {width:g} must be 1 .. {_MOST_WIDTH_PX:g}")
    points = _places(f"{key}.points", value.get("points"), 3 if width is None else 1)
    return Stroke(do=value["do"], points=points, width_px=width)


def _places(key: str, value: Any, least: int) -> tuple[Place, ...]:
    if not isinstance(value, list) or not least <= len(value) <= MOST_POINTS:
        raise UsageError(f"{key} must be a list of {least} .. {MOST_POINTS} points [column, row]")
    return tuple(parse_point(key, one) for one in value)


def parse_point(key: str, value: Any) -> Place:
    """Read ``[column, row]``.

    Raises
    ------
    UsageError, GeometryError
    """
    if not isinstance(value, list) or len(value) != 2:
        raise UsageError(f"{key}: {quote(value)} must be [column, row], or null where unseen")
    place = number(key, value[0]), number(key, value[1])
    if any(abs(x) > _FARTHEST_PX for x in place):
        raise UsageError(f"{key}: {quote(value)} lies in no picture")
    return place


def _brush(canvas: Array, points: tuple[Place, ...], width: float, value: int) -> None:
    """Set the pixels within half the width of a line; OpenCV's own thick lines are too wide."""
    import cv2
    import numpy as np

    from gcar_deploy.imaging.distance import exact_distance

    whole = np.array(points)
    reach = int(np.ceil(width / 2)) + 2
    # Only what lies near the picture is drawn, however far the line leads.
    low = np.maximum(np.floor(whole.min(axis=0)).astype(int), 0) - reach
    high = np.minimum(np.ceil(whole.max(axis=0)).astype(int), canvas.shape[::-1]) + reach + 1
    if (high <= low).any():
        return
    room = np.ones((high[1] - low[1], high[0] - low[0]), np.uint8)
    line = _fixed(tuple((c - low[0], r - low[1]) for c, r in points))
    # One point alone is a dot, which polylines leaves out.
    line = np.repeat(line, 2, axis=0) if len(line) == 1 else line
    cv2.polylines(room, [line], False, 0, 1, cv2.LINE_8, _SHIFT)
    near = exact_distance(room > 0) <= width / 2
    at = np.argwhere(near) + low[::-1]
    at = at[((at >= 0) & (at < canvas.shape)).all(axis=1)]
    canvas[at[:, 0], at[:, 1]] = value


def _fixed(points: tuple[Place, ...]) -> Array:
    """(n, 1, 2) int32, with fractions of pixels as OpenCV draws them."""
    import numpy as np

    return np.rint(np.array(points) * 2**_SHIFT).astype(np.int32)[:, None]


def _fill(canvas: Array, corners: tuple[Place, ...], value: int) -> None:
    import cv2

    cv2.fillPoly(canvas, [_fixed(corners)], value, cv2.LINE_8, _SHIFT)
