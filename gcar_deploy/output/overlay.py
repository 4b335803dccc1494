"""overlay_view*.png: each picture with the reprojected centreline, readable on its own."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.errors import GcarError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.output.colors import branch_color
from gcar_deploy.output.words import LEFT_OUT, explained
from gcar_deploy.quality import PROBABLE, ViewQuality
from gcar_deploy.tree.tree import Tree, along, polyline_arc
from gcar_deploy.types import Array, Image, Mask, Pixels, Scalars

#: smaller pictures are enlarged by a whole number until labels are readable
_MIN_WIDTH = 768
#: but never beyond this: a long strip would become huge
_MAX_SIDE = 4096
#: pictures are dimmed, so that thin coloured lines stand out on bright vessels as well
_DIM = 0.65
_SHIFT = 4
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_BAR_MM = 20
_WHITE, _BLACK, _RED = (255, 255, 255), (0, 0, 0), (60, 40, 255)
#: what was left out; no branch is grey
_DEVICE = (200, 200, 200)
_AROUND = tuple((dx, dy) for dx in (-2, -1, 0, 1, 2) for dy in (-2, -1, 0, 1, 2) if dx or dy)
#: PNG by zlib's quickest, rows as they are: a third of the time, and a tenth more bytes
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
if hasattr(cv2, "IMWRITE_PNG_FILTER"):  # OpenCV 4.12 or newer
    _PNG += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]
#: branches shorter than this on the screen get no number, pixels
_LEAST_NUMBERED = 30
#: where along its branch a number may stand, shares of its length, the first with room
_ALONG = (0.5, 0.35, 0.65, 0.2, 0.8, 0.1, 0.9)
#: how dark the legend's plate makes what lies under it
_PLATE = 0.3
#: left, top, right, bottom of a part of the picture, pixels
Box = tuple[int, int, int, int]


def grey8(pixels: Image) -> Array:
    """(rows, cols) uint8 of a picture, stretched between its 0.5 and 99.8 percentiles."""
    low, high = (float(x) for x in np.percentile(pixels, (0.5, 99.8)))
    if high <= low:
        low, high = float(pixels.min()), max(float(pixels.max()), float(pixels.min()) + 1.0)
    stretched: Array = np.clip((pixels - low) / (high - low) * 255.0, 0, 255).astype(np.uint8)
    return stretched


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Backdrop:
    """A dimmed picture, (rows, cols, 3) uint8 blue green red, enlarged by the whole number zoom."""

    picture: Array
    zoom: int


def backdrop(pixels: Image, missing: Mask, device: Mask | None = None) -> Backdrop:
    """Dim and enlarge a picture until it is at least 768 wide.

    Parameters
    ----------
    pixels : (rows, cols) float32 picture as it was given
    missing : (rows, cols) what the tree leaves unexplained, which becomes red
    device : (rows, cols) what was left out, which becomes light grey
    """
    rows, columns = pixels.shape
    zoom = min(math.ceil(_MIN_WIDTH / columns), max(1, _MAX_SIDE // max(rows, columns)))
    base = cv2.resize(grey8(pixels), None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)
    canvas = cv2.cvtColor((base * _DIM).astype(np.uint8), cv2.COLOR_GRAY2BGR)
    if device is not None:
        _mark(canvas, device, zoom, _DEVICE)
    _mark(canvas, missing, zoom, _RED)
    return Backdrop(picture=canvas, zoom=zoom)


def overlay(
    behind: Backdrop,
    view: VesselImage,
    tree: Tree,
    judged: ViewQuality,
    ghosts: Sequence[Scalars] = (),
) -> Array:
    """Draw the tree over one view.

    Parameters
    ----------
    behind : Backdrop
    view : what was found in the picture, with the C-arm as it was used (pose applied)
    tree : Tree
    judged : ViewQuality, for the label
    ghosts : per branch (m,) ``ghost_probability``; probable ghosts are dashed

    Returns
    -------
    (rows, cols, 3) uint8, blue green red
    """
    canvas, zoom = behind.picture.copy(), behind.zoom
    lines = [_line(branch.points_mm, view.carm, zoom) for branch in tree.branches]
    doubtful = [
        _line(branch.points_mm[first:stop], view.carm, zoom)
        for branch, told in zip(tree.branches, ghosts, strict=bool(ghosts))
        for first, stop in _runs(told >= PROBABLE)
    ]
    width = max(2, round(canvas.shape[1] / 500))
    # A dark casing under each line keeps every colour readable on bright vessels.
    for extra, cased in ((2, True), (0, False)):
        for number, line in enumerate(lines):
            if len(line) > 1:
                points = np.rint(line * 2**_SHIFT).astype(np.int32)
                color = _BLACK if cased else branch_color(number)
                cv2.polylines(canvas, [points], False, color, width + extra, cv2.LINE_AA, _SHIFT)
    # Gaps, not a colour: eyes that tell few colours apart see them as well.
    for line in doubtful:
        for dash in _gaps(line, 4 * width):
            points = np.rint(dash * 2**_SHIFT).astype(np.int32)
            cv2.polylines(canvas, [points], False, _BLACK, width + 1, cv2.LINE_8, _SHIFT)
    device = view.catheter is not None and bool(view.catheter.any())
    taken = _labels(canvas, judged)
    taken.append(_legend(canvas, lines, taken[-1][3], bool(doubtful), device))
    taken.append(_scale_bar(canvas, view.carm.pixel_at_isocenter_mm / zoom))
    _numbers(canvas, lines, taken)
    return canvas


def png_bytes(picture: Array) -> bytes:
    """Encode a picture as PNG.

    Raises
    ------
    GcarError
        OpenCV could not.
    """
    ok, data = cv2.imencode(".png", picture, _PNG)
    if not ok:
        raise GcarError("a picture could not be encoded as PNG")
    return bytes(data.tobytes())


def _line(points_mm: Array, carm: CArm, zoom: int) -> Pixels:
    """(n, 2) col, row of the enlarged picture; only what lies in front of the source."""
    pixels, depth = carm.project(points_mm)
    line: Pixels = np.clip((pixels[depth > 1.0] + 0.5) * zoom - 0.5, -16000, 16000)
    return line


def _runs(wanted: Mask) -> list[tuple[int, int]]:
    """First and behind the last point of each run of two or more."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], wanted, [0]]))).reshape(-1, 2)
    return [(first, stop) for first, stop in edges.tolist() if stop - first > 1]


def _gaps(line: Pixels, dash: float) -> list[Pixels]:
    """Every other piece of a line that is cut into pieces of ``dash`` pixels, the second first."""
    if len(line) < 2:
        return []
    arc = polyline_arc(line)
    starts = np.arange(dash, arc[-1], 2 * dash)
    return [along(line, arc, np.linspace(a, min(a + dash, arc[-1]), 6)) for a in starts]


def _mark(canvas: Array, missing: Mask, zoom: int, color: tuple[int, int, int]) -> None:
    """Paint pixels of the picture."""
    size = (canvas.shape[1], canvas.shape[0])
    big = cv2.resize(missing.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    if zoom < 4:
        big = cv2.dilate(big, np.ones((3, 3), np.uint8))
    canvas[big > 0] = color


def _numbers(canvas: Array, lines: list[Pixels], taken: Sequence[Box]) -> None:
    """Write the number of each branch beside it, in or near its middle, where there is room."""
    rows, columns = canvas.shape[:2]
    scale = max(columns / 1500, 0.5)
    boxes, gap, high = list(taken), round(8 * scale), round(22 * scale)
    for number, line in enumerate(lines):
        if len(line) < 2 or np.ptp(line, axis=0).max() < _LEAST_NUMBERED:
            continue
        text = str(number + 1)
        wide = _width(text, scale)
        for share in _ALONG:
            at = line[round(share * (len(line) - 1))]
            x, y = round(at[0]) + 8, round(at[1]) - 6
            box = (x - gap, y - high - gap, x + wide + gap, y + gap)
            inside = box[0] >= 0 and box[1] >= 0 and box[2] <= columns and box[3] <= rows
            if inside and not any(_meet(box, other) for other in boxes):
                boxes.append((x, y - high, x + wide, y))
                _text(canvas, text, (x, y), scale, branch_color(number))
                break


def _meet(one: Box, other: Box) -> bool:
    return (
        one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]
    )  # fmt: skip


def _labels(canvas: Array, judged: ViewQuality) -> list[Box]:
    """Write at the top left which view it is and how much of it is explained; where."""
    size = max(canvas.shape[1] / 1000, 0.6)
    title = f"View {judged.view_id}: {judged.name}"
    _text(canvas, title, (14, round(34 * size)), size)
    boxes = [(0, 0, 14 + _width(title, size), round(42 * size))]
    if judged.coverage is not None:
        text = explained(judged.coverage, judged.coverage_even, judged.left_out)
        _text(canvas, text, (14, round(62 * size)), 0.7 * size)
        boxes.append((0, boxes[0][3], 14 + _width(text, 0.7 * size), round(70 * size)))
    return boxes


def _scale_bar(canvas: Array, pixel_mm: float) -> Box:
    """Draw it at the bottom left; where."""
    rows, columns = canvas.shape[:2]
    size = max(columns / 1600, 0.5)
    x, y, width = 14, rows - 16, max(2, round(_BAR_MM / pixel_mm))
    cv2.line(canvas, (x, y), (x + width, y), _BLACK, 6, cv2.LINE_AA)
    cv2.line(canvas, (x, y), (x + width, y), _WHITE, 2, cv2.LINE_AA)
    text = f"{_BAR_MM} mm at the isocentre"
    _text(canvas, text, (x, y - round(20 * size)), size)
    return 0, y - round(46 * size), x + max(width, _width(text, size)), rows


def _legend(canvas: Array, lines: list[Pixels], below: int, dashed: bool, device: bool) -> Box:
    """Say what the colours mean, at the right where fewer branches lie, on a dark plate; where.

    ``below`` is where the words at the top end.
    """
    rows, columns = canvas.shape[:2]
    size = max(columns / 1600, 0.5)
    entries = [("centreline, a colour a branch", branch_color(0)), ("vessel not explained", _RED)]
    if dashed:
        entries.insert(1, ("dashed: probably not there", branch_color(0)))
    if device:
        entries.append((LEFT_OUT, _DEVICE))
    step = round(34 * size)
    wide = max(_width(text, size) for text, _ in entries)
    left = max(columns - 14 - wide, 0)
    high = step * len(entries) + round(12 * size)
    # The last line's foot stands 16 pixels above the border.
    corners = [rows - 8 - high, min(below, rows - 8 - high)]
    boxes: list[Box] = [(max(left - 54, 0), max(y, 0), columns - 6, y + high) for y in corners]
    x0, y0, x1, y1 = min(boxes, key=lambda box: _points_in(lines, box))
    canvas[y0:y1, x0:x1] = (canvas[y0:y1, x0:x1] * _PLATE).astype(np.uint8)
    for k, (text, color) in enumerate(entries):
        row = y1 - 8 - step * (len(entries) - 1 - k)
        middle = row - round(9 * size)
        cv2.line(canvas, (left - 44, middle), (left - 12, middle), _BLACK, 6, cv2.LINE_AA)
        cv2.line(canvas, (left - 44, middle), (left - 12, middle), color, 3, cv2.LINE_AA)
        if text.startswith("dashed"):
            cv2.line(canvas, (left - 33, middle), (left - 23, middle), _BLACK, 4)
        _text(canvas, text, (left, row), size)
    return x0, y0, x1, y1


def _points_in(lines: list[Pixels], box: Box) -> int:
    points = np.concatenate([np.zeros((0, 2)), *lines])
    return int(((points >= box[:2]) & (points < box[2:])).all(axis=1).sum())


def _width(text: str, size: float) -> int:
    return int(cv2.getTextSize(text, _FONT, size, 1)[0][0])


def _text(
    canvas: Array,
    text: str,
    at: tuple[int, int],
    size: float,
    color: tuple[int, int, int] = _WHITE,
) -> None:
    # Hershey fonts know ASCII only; what does not fit is cut rather than drawn outside.
    shown = text.encode("ascii", "replace").decode("ascii")
    room = canvas.shape[1] - at[0] - 8
    while len(shown) > 1 and _width(shown, size) > room:
        shown = shown[:-2] + "."
    # The outline is the same text moved about: a thicker stroke would be wider letter by letter.
    for dx, dy in _AROUND:
        cv2.putText(canvas, shown, (at[0] + dx, at[1] + dy), _FONT, size, _BLACK, 1, cv2.LINE_AA)
    cv2.putText(canvas, shown, at, _FONT, size, color, 1, cv2.LINE_AA)
