"""Lines of a raw picture that may be something else than vessel, for the views to decide.

A catheter comes from the border of the field and goes on straight where it crosses a vessel; a
lead, a rib or a wire often stands apart from the tree. A vessel may do either, so nothing of the
picture alone says which it is.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import cv2
import numpy as np

from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.border import inward_px
from gcar_deploy.imaging.device_lines import device_parts
from gcar_deploy.imaging.distance import exact_distance
from gcar_deploy.imaging.linegraph import LineGraph, Pixel
from gcar_deploy.imaging.net import SIDE, network_scale
from gcar_deploy.types import Array, Mask

#: so near to the border of the field a line comes from outside, mm
BORDER_MM = 4.0
#: what goes on from a device over this much of its way, and is so many times as wide, is the vessel
#: that it fills
_FILLED_MM, WIDER = (3.0, 15.0), 1.3
#: the vessel beyond an inlet is asked for its width over so much, mm
_INLET_MM = 4.0
#: a stretch of the tree that is so probably a device is a line of its own
INSIDE = 0.5
#: side branches shorter than this are spurs; lines shorter than this move nothing; longest, mm
SPUR_MM, SHORTEST_MM, LONGEST_MM = 6.0, 8.0, 160.0
#: a line goes on through a fork where it turns by no more than this over so much of its way
THROUGH_DEG, _WAY_MM = 25.0, 4.0
#: a line that comes back reaches so much further, pixels to each side
_END = np.ones((9, 9), np.uint8)


def stray_lines(view: VesselImage) -> Iterator[Mask]:
    """Yield (rows, cols) bool parts of the view's skeleton that may be no vessel.

    Parts beside the largest; what comes from the border, or goes on from a device that was left
    out, to its first fork; what comes from the border to where it is wider of a sudden, the inlet
    of the artery; and the same line on through forks as long as it goes straight.
    """
    line = view.skeleton
    px = 1.0 / view.carm.pixel_at_isocenter_mm
    count, label = cv2.connectedComponents(line.astype(np.uint8), connectivity=8)
    size = np.bincount(label[line], minlength=count)
    yield from (label == k for k in range(1, count)
                if k != size.argmax() and size[k] >= SHORTEST_MM * px)  # fmt: skip
    graph = LineGraph(line)
    near, half = _near_border(view), exact_distance(view.mask)
    for end in graph.ends(line & (near | _beside_device(view, px))):
        if not near[end] and _fills(view, graph, end, px):
            continue
        path, spurs = graph.walk(end, SPUR_MM * px, LONGEST_MM * px)
        if len(path) >= SHORTEST_MM * px:
            yield drawn(line, [*path, *spurs])
        if near[end] and (inlet := _inlet(path, half, px)) is not None:
            yield drawn(line, path[:inlet])
        further = _straight_on(graph, path, px)
        if len(further) >= len(path) + SHORTEST_MM * px:
            yield drawn(line, further)


def _beside_device(view: VesselImage, px: float) -> Mask:
    """Where a line may go on from a device that was left out."""
    if view.catheter is None or not view.catheter.any():
        return np.zeros_like(view.mask)
    beside = cv2.distanceTransform((~view.catheter).astype(np.uint8), cv2.DIST_L2, 5)
    near: Mask = beside <= BORDER_MM * px
    return near


def _fills(view: VesselImage, graph: LineGraph, end: Pixel, px: float) -> bool:
    """Whether the line from ``end`` is wider than the device before it: a catheter's ostium."""
    first, last = (round(mm * px) for mm in _FILLED_MM)
    path, _ = graph.walk(end, SPUR_MM * px, last)
    whole = view if view.kept is None else view.kept()
    before = np.argwhere(_lost(view, whole))
    before = before[np.hypot(*(before - end).T) <= last]
    if len(path) <= first or not len(before):
        return False
    half = exact_distance(whole.mask)
    own, device = (float(np.median(half[tuple(np.transpose(p))])) for p in (path[first:], before))
    return own >= WIDER * device


def _inlet(path: list[Pixel], half: Array, px: float) -> int | None:
    """Return after how many pixels a line from outside is wider at once; None where nowhere."""
    least, over = round(SHORTEST_MM * px), round(_INLET_MM * px)
    wide = half[tuple(np.transpose(path))]
    places = range(least, len(path) - over)
    if not places:
        return None
    wider = [float(np.median(wide[k : k + over]) / np.median(wide[k - least : k])) for k in places]
    most = int(np.argmax(wider))
    return places[most] if wider[most] >= WIDER else None


def likely_devices(view: VesselImage, level: float) -> Iterator[Mask]:
    """Yield (rows, cols) bool parts of the view's skeleton that are so probably a device."""
    if view.device is None:
        return
    rows, columns = view.mask.shape
    finer = 1 / network_scale(rows, columns, SIDE)
    yield from device_parts(view.skeleton, view.device, level, finer)


def without_line(view: VesselImage, stray: Mask) -> VesselImage | None:
    """Return the view without a part of its skeleton and what lies along it; None if all goes."""
    line = view.skeleton
    left = line & ~stray
    if not left.any():
        return None
    reach = view.path_mm > 0
    gone = skel.beside_alone(reach, line, stray)
    mask = view.mask & ~gone
    device = gone & view.mask if view.catheter is None else view.catheter | (gone & view.mask)
    return dataclasses.replace(
        view, others=(), mask=mask, skeleton=skel.skeletonize(mask), catheter=device,
        path_mm=np.where(gone, np.float32(0), view.path_mm),
    )  # fmt: skip


def lost_lines(view: VesselImage, whole: VesselImage) -> Iterator[Mask]:
    """Yield (rows, cols) bool parts of the whole view's skeleton that were taken for a device."""
    line = _lost(view, whole)
    count, label = cv2.connectedComponents(line.astype(np.uint8), connectivity=8)
    size = np.bincount(label[line], minlength=count)
    least = SHORTEST_MM / view.carm.pixel_at_isocenter_mm
    yield from (label == k for k in range(1, count) if size[k] >= least)


def comes_from_outside(view: VesselImage, line: Mask) -> bool:
    """Whether a line reaches the border of the field."""
    return bool((line & _near_border(view)).any())


def shows_device(view: VesselImage) -> bool:
    """Whether something from outside was left out of the view as a device."""
    return view.catheter is not None and comes_from_outside(view, view.catheter)


def _near_border(view: VesselImage) -> Mask:
    near: Mask = inward_px(view.valid) <= BORDER_MM / view.carm.pixel_at_isocenter_mm
    return near


def with_line(view: VesselImage, whole: VesselImage, lost: Mask) -> VesselImage:
    """Return the view with a part of the whole one's skeleton and what lies along it."""
    # Where it was cut off from the tree, its end went as well.
    longer = cv2.dilate(lost.astype(np.uint8), _END) > 0
    back = skel.beside(whole.path_mm > 0, whole.skeleton, longer & whole.skeleton)
    mask, device = view.mask | (whole.mask & back), view.catheter
    if device is not None:
        own = skel.beside_alone(skel.parts_touching(device, lost), _lost(view, whole), lost)
        device = device & ~mask & ~own
    return dataclasses.replace(
        view, others=(), mask=mask, skeleton=skel.skeletonize(mask), catheter=device,
        path_mm=np.where(back & (view.path_mm <= 0), whole.path_mm, view.path_mm),
    )  # fmt: skip


def _lost(view: VesselImage, whole: VesselImage) -> Mask:
    if view.catheter is None:
        return np.zeros_like(view.mask)
    return whole.skeleton & view.catheter


def _straight_on(graph: LineGraph, path: list[Pixel], px: float) -> list[Pixel]:
    """Go on from the last pixel of a path through forks, as long as there is a straight way."""
    path, seen = list(path), set(path)
    way = max(3, round(_WAY_MM * px))
    while len(path) < LONGEST_MM * px:
        here = path[-1]
        before = np.subtract(here, path[-way] if len(path) >= way else path[0])
        ahead = [(_cosine(before, np.subtract(_reached(graph, seen, here, p, way), here)), p)
                 for p in graph.joined(here) if p not in seen]  # fmt: skip
        if not ahead:
            break
        straightest, pixel = max(ahead)
        if len(ahead) > 1 and straightest < math.cos(math.radians(THROUGH_DEG)):
            break
        path.append(pixel)
        seen.add(pixel)
    return path


def _reached(graph: LineGraph, seen: set[Pixel], here: Pixel, first: Pixel, steps: int) -> Pixel:
    """Where so many steps from ``here`` by way of ``first`` lead, as far away as they can."""
    trod, at = {*seen, first}, first
    for _ in range(steps - 1):
        onward = [p for p in graph.joined(at) if p not in trod]
        if not onward:
            break
        at = max(onward, key=lambda p: (math.dist(p, here), p))
        trod.add(at)
    return at


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    return float(a @ b) / max(float(np.hypot(*a) * np.hypot(*b)), 1e-9)


def drawn(line: Mask, pixels: list[Pixel]) -> Mask:
    """(rows, cols) bool: these pixels of a picture as large as ``line``."""
    out = np.zeros_like(line)
    out[tuple(np.transpose(pixels))] = True
    return out
