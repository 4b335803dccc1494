"""What the page shows of a result, as JSON values and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import epipolar_lines
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.polarity import is_dark
from gcar_deploy.output.overlay import grey8, png_bytes
from gcar_deploy.output.report_data import scene_data
from gcar_deploy.result import Result
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Image, Mask, Pixels
from gcar_deploy.workbench.alternatives import alternatives
from gcar_deploy.workbench.trace import bright_picture

#: blue, green, red, opacity: vessel, its line, catheter. Apart for all kinds of colour vision
_VESSEL, _LINE, _CATHETER = (233, 180, 86, 110), (255, 255, 255, 220), (0, 159, 230, 170)
#: vessels within so many pixels of an epipolar line are crossed by it
_CROSSED_PX = 0.75


def result_data(result: Result) -> dict[str, Any]:
    """Return tree, lesions, ways from ostium to tip, what else there may be, and the summary."""
    summary = result.summary()
    scene = scene_data(result)
    for branch, row in zip(scene["branches"], summary["tree"]["branches"], strict=True):
        branch["middle"] = middle(result.tree, branch["branch"] - 1)
        branch["row"] = row
    return {
        "summary": summary, "scene": scene, "ways": ways(result.tree),
        "alternatives": alternatives(result),
    }  # fmt: skip


def middle(tree: Tree, branch: int) -> list[float]:
    """Return the place halfway along a branch, mm LPS: it names the branch in an order."""
    one = tree.branches[branch]
    at = int(np.argmin(np.abs(one.arc_mm - 0.5 * one.length_mm)))
    return [round(float(x), 2) for x in one.points_mm[at]]


def ways(tree: Tree) -> list[list[int]]:
    """Numbers of the branches from an ostium to each tip, the longest way first."""
    before: dict[int, int] = {}
    for k, branch in enumerate(tree.branches):
        before.setdefault(branch.end, k)
    starts = {branch.start for branch in tree.branches}
    found = []
    for k, branch in enumerate(tree.branches):
        if branch.end in starts:
            continue
        way = [k]
        while (start := tree.branches[way[0]].start) in before and before[start] not in way:
            way.insert(0, before[start])
        found.append(way)
    found.sort(key=lambda way: -sum(tree.branches[k].length_mm for k in way))
    return [[k + 1 for k in way] for way in found]


def picture_png(pixels: Image) -> bytes:
    """Return a picture as grey PNG."""
    return png_bytes(grey8(pixels))


def flat_png(angiogram: Angiogram) -> bytes:
    """Return a picture without its background, grey PNG; vessels dark where they were."""
    flat = bright_picture(angiogram)
    return png_bytes(grey8(-flat if is_dark(angiogram) else flat))


def thumbnail_png(pixels: Image, side: int) -> bytes:
    """Return a small grey PNG."""
    scale = min(1.0, side / max(pixels.shape))
    size = (max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale)))
    return png_bytes(cv2.resize(grey8(pixels), size, interpolation=cv2.INTER_AREA))


def found_png(view: VesselImage) -> bytes:
    """Return what was found in a view as transparent colours to lay over it."""
    canvas = np.zeros((*view.mask.shape, 4), np.uint8)
    if view.catheter is not None:
        canvas[view.catheter] = _CATHETER
    canvas[view.mask] = _VESSEL
    canvas[view.skeleton] = _LINE
    return png_bytes(canvas)


def epipolar(
    carms: Sequence[CArm], skeletons: Sequence[Mask] | None, view: int, point: tuple[float, float]
) -> list[dict[str, Any]]:
    """Line on which a point of one view lies in each other, and where it crosses vessels.

    Parameters
    ----------
    carms : the views
    skeletons : (rows, cols) of each, or None
    view : from 0, where the point was marked
    point : (column, row)

    Returns
    -------
    per other view its number (from 1), the line's two ends at the picture's border ([] where it
    misses the picture), and the crossings from end to end
    """
    out = []
    for k, carm in enumerate(carms):
        if k == view:
            continue
        line = epipolar_lines(carms[view], carm, np.array([point]))[0]
        crossed = [] if skeletons is None else _crossings(line, skeletons[k])
        out.append({"view": k + 1, "line": _ends(line, carm), "crossings": crossed})
    return out


def _ends(line: Array, carm: CArm) -> list[list[float]]:
    a, b, c = (float(x) for x in line)
    found = []
    for column in (0.0, carm.columns - 1.0):
        if abs(b) > 1e-9:
            found.append((column, -(a * column + c) / b))
    for row in (0.0, carm.rows - 1.0):
        if abs(a) > 1e-9:
            found.append((-(b * row + c) / a, row))
    inside = [
        (x, y) for x, y in found if -1e-6 <= x <= carm.columns - 1 and -1e-6 <= y <= carm.rows - 1
    ]
    if len(inside) < 2:
        return []
    ends = [min(inside), max(inside)]
    return [[round(x, 2), round(y, 2)] for x, y in ends]


def _crossings(line: Array, skeleton: Mask) -> list[list[float]]:
    """Vessel pixels on the line, one for each vessel that it crosses."""
    rows, columns = np.nonzero(skeleton)
    pixels = np.column_stack([columns, rows]).astype(float)
    near = pixels[np.abs(pixels @ line[:2] + line[2]) <= _CROSSED_PX]
    if not len(near):
        return []
    along = near @ np.array([-line[1], line[0]])
    order = np.argsort(along, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(along[order]) > 3.0) + 1)
    return [[round(float(x), 1) for x in _foot(near[group], line)] for group in groups]


def _foot(pixels: Pixels, line: Array) -> Array:
    """(2,) middle of some pixels, put onto the line."""
    middle: Array = pixels.mean(axis=0)
    return middle - (middle @ line[:2] + line[2]) * line[:2]
