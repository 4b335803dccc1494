"""Catheters among the lines found: even, unbranched, from the border to a wider vessel.

Leads and wires that cross the whole field go with them, and shafts that are none but by their
course (``shaft``).

A catheter enters the field at its border, keeps its width to the tip, and ends at the ostium,
where the vessel that it fills is wider. A vessel that leaves the field tapers towards the
border instead, or branches, or joins a parent that goes on to both sides. What is undecided
stays a vessel: losing the main vessel is worse than keeping a catheter.
"""

from __future__ import annotations

import cv2
import numpy as np

from gcar_deploy.imaging import enhance
from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.border import inward_px
from gcar_deploy.imaging.linegraph import LineGraph, Pixel
from gcar_deploy.imaging.shaft import shaft
from gcar_deploy.types import Image, Mask, Scalars

#: a catheter comes within this distance of the border of the field, mm
BORDER_MM = 3.0
#: from the border to the tip; a side branch shorter than the spur is none, mm
SHORTEST_MM, LONGEST_MM = 5.0, 80.0
SPUR_MM = 8.0
#: width at half height, blur included (8 F are 2.7 mm), and its standard deviation along the
#: catheter as a share of it
WIDEST_MM = 4.2
UNEVENNESS = 0.06
#: the vessel beyond the tip is this many times wider, its narrow places (lower 30 %) too
STEP, LEAST_STEP = 1.5, 1.1
#: and it is a main one: its width as a share of the 90th percentile of all
VESSEL_SHARE = 0.6
#: no vessel goes through the place where it ends: two arms at least this wide (share of the
#: widest) and this straight
ARM_SHARE = 0.65
THROUGH_DEG = 150.0
#: a line from border to border as long as this share of the picture's shorter side that stays
#: close to its chord (90 % of it, as a share of the chord) is a lead or a wire
CROSSING_SHARE, CROSSING_OFF_SHARE = 0.6, 0.025
#: more of the line than this is never taken for catheters
LARGEST_SHARE = 0.25
#: offsets at which a profile across the line is sampled, pixels, and its farthest one in mm
_OFFSET_STEP = 0.25
_PROFILE_MM = 6.0
#: of the profile, in units of the ridge filter's sigma: beyond lies another vessel
_PROFILE_SIGMAS = 3.2
#: ends of the stretches, along the line, whose widths are compared: before the cut (its last
#: part is blurred with what follows) and after it; and where branches at a fork are looked at
_BEFORE_MM = 2.0
_AFTER_MM = (2.5, 12.0)
_FORK_MM = (4.0, 6.5)
#: half the distance of the outer two is a standard deviation that a few wrong widths (at the
#: border, where another line crosses) do not move
_QUANTILES = (0.15, 0.5, 0.85)


def catheters(
    line: Mask,
    flat: Image,
    sigma_px: Image,
    valid: Mask,
    pixel_mm: float,
) -> Mask:
    """Pixels of ``line`` that are taken for catheter.

    Parameters
    ----------
    line : (rows, cols) bool
        Centrelines, one pixel wide.
    flat : (rows, cols) float32
        Picture without its slow variation, vessels bright.
    sigma_px : (rows, cols) float32
        Width at which the ridge filter answered most, pixels.
    valid : (rows, cols) bool
        The field; a line that comes within reach of its border or the picture's may be one.
    pixel_mm : float, at the isocentre

    Returns
    -------
    (rows, cols) bool, a part of ``line``
    """
    found = np.zeros_like(line)
    total_mm = int(line.sum()) * pixel_mm
    if total_mm == 0:
        return found
    inward = inward_px(valid) * pixel_mm
    graph = LineGraph(line)
    ends = graph.ends(line & (inward <= BORDER_MM + 0.5 * WIDEST_MM))
    if not ends:
        return found
    width = line_widths(line, flat, sigma_px, pixel_mm)
    widest = float(np.quantile(width[line], 0.9))
    for pixels in _crossings(graph, ends, min(line.shape)):
        found[tuple(np.transpose(pixels))] = True
    crossing = found
    free = [end for end in ends if not found[end]]
    cuts = [_cut(graph, end, width, widest, inward, pixel_mm) for end in free]
    shafts = [shaft(graph, end, width, widest, pixel_mm) for end in free]
    # The clearest first, then the longest, as long as most of the line stays.
    clearest = [pixels for _, pixels in sorted((c for c in cuts if c is not None), reverse=True)]
    for pixels in [*clearest, *sorted(filter(None, shafts), key=len, reverse=True)]:
        tried = found.copy()
        tried[tuple(np.transpose(pixels))] = True
        if (tried & ~crossing).sum() * pixel_mm <= LARGEST_SHARE * total_mm:
            found = tried
    return found


def _crossings(graph: LineGraph, ends: list[Pixel], side_px: int) -> list[list[Pixel]]:
    """Lines from border to border that stay close to their chord: longer than any vessel does."""
    found = []
    for i, one in enumerate(ends):
        others = [p for p in ends[:i] if np.hypot(*np.subtract(p, one)) >= CROSSING_SHARE * side_px]
        reached = graph.distances(one, np.inf, ()) if others else {}
        for other in others:
            if other not in reached:
                continue
            path = graph.shortest(reached, other)
            chord = np.subtract(other, one)
            row, column = (np.asarray(path) - one).T
            # distance from the chord as a share of the chord
            off = np.abs(row * chord[1] - column * chord[0]) / (chord @ chord)
            if np.sort(off)[len(off) * 9 // 10] <= CROSSING_OFF_SHARE:
                found.append(path)
    return found


def line_widths(line: Mask, flat: Image, sigma_px: Image, pixel_mm: float) -> Image:
    """(rows, cols) float32, mm: width at half height, carried from the line to every pixel.

    Each side is measured against its own lowest value within reach, since the background may
    have a step along the vessel.
    """
    rows, columns = np.nonzero(line)
    normal = enhance.curvature(flat, max(1.0, 0.75 / pixel_mm))[2]
    angle = normal[rows, columns, None]
    offset = np.arange(0, _PROFILE_MM / pixel_mm, _OFFSET_STEP, dtype=np.float32)
    smooth = cv2.GaussianBlur(flat, (0, 0), 0.8)
    sides = [
        cv2.remap(
            smooth,
            columns[:, None].astype(np.float32) + s * offset * np.cos(angle),
            rows[:, None].astype(np.float32) + s * offset * np.sin(angle),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        for s in (np.float32(1), np.float32(-1))
    ]
    top = 0.5 * sum(side[:, :3].mean(axis=1) for side in sides)
    near = offset <= _PROFILE_SIGMAS * sigma_px[rows, columns, None] + 2 * _OFFSET_STEP
    width = np.zeros(line.shape, np.float32)
    for side in sides:
        base = np.where(near, side, np.inf).min(axis=1)
        below = side < 0.5 * (top + base)[:, None]
        first = np.where(below.any(axis=1), below.argmax(axis=1), len(offset) - 1)
        width[rows, columns] += offset[first] * np.float32(pixel_mm)
    return skel.spread(line, (width,), max(1.0, 1.0 / pixel_mm))[1][0]


def _cut(
    graph: LineGraph,
    end: Pixel,
    width: Image,
    widest: float,
    inward: Image,
    pixel_mm: float,
) -> tuple[float, list[Pixel]] | None:
    """Where the line from ``end`` stops being a catheter, if it ever was one.

    Returns
    -------
    clearness : float
        Ratio of the narrow places beyond the cut to the wide ones before it.
    pixels : list of Pixel, from the end to the cut, with the spurs in between
    """
    path, spurs = graph.walk(end, SPUR_MM / pixel_mm, LONGEST_MM / pixel_mm)
    beyond = graph.distances(path[-1], (_AFTER_MM[1] + 1) / pixel_mm, path[:-1])
    along = _lengths(path) * pixel_mm
    passes = _passes_by(graph, path[-1], beyond, width, pixel_mm)
    before_mm = width[tuple(np.transpose(path))]
    del beyond[path[-1]]
    place = np.r_[along, [along[-1] + d * pixel_mm for d in beyond.values()]]
    all_at = tuple(np.transpose([*path, *beyond]))
    all_mm = width[all_at]
    # A line that leaves the field looks wider at its border: no place for an ostium.
    place[inward[all_at] < BORDER_MM] = -np.inf
    best: tuple[float, float] | None = None
    for cut in np.arange(SHORTEST_MM, along[-1] + 0.5, 1.0):
        if passes and along[-1] < cut + 0.75 * _AFTER_MM[1]:
            break
        before = np.sort(before_mm[along <= cut - _BEFORE_MM])
        low, own, high = (float(before[int(len(before) * q)]) for q in _QUANTILES)
        if own > WIDEST_MM or 0.5 * (high - low) > UNEVENNESS * own:
            continue
        after = np.sort(all_mm[(place >= cut + _AFTER_MM[0]) & (place <= cut + _AFTER_MM[1])])
        if len(after) * pixel_mm < 0.5 * _AFTER_MM[1]:
            continue
        narrow, wide = float(after[len(after) * 3 // 10]), float(after[len(after) * 7 // 10])
        if wide >= max(STEP * own, VESSEL_SHARE * widest) and narrow >= LEAST_STEP * own:
            clear = narrow / high
            best = max(best, (clear, float(cut))) if best else (clear, float(cut))
    if best is None:
        return None
    count = int(np.searchsorted(along, best[1])) + 1
    return best[0], sorted({*path[:count], *_hanging(graph, path, count, spurs)})


def _lengths(path: list[Pixel]) -> Scalars:
    steps = np.diff(np.asarray(path, dtype=np.float64), axis=0)
    return np.r_[0.0, np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))]


def _hanging(graph: LineGraph, path: list[Pixel], count: int, spurs: set[Pixel]) -> set[Pixel]:
    """Spurs that leave the path before pixel ``count``."""
    reached = graph.distances(path[0], np.inf, path[count:]).keys() if spurs else set()
    return spurs & set(reached)


def _passes_by(
    graph: LineGraph,
    fork: Pixel,
    beyond: dict[Pixel, float],
    width: Image,
    pixel_mm: float,
) -> bool:
    """Whether a vessel goes through the fork: then the line is its side branch."""
    low, high = (mm / pixel_mm for mm in _FORK_MM)
    stretches = [s for s in graph.branches(beyond, low, high) if len(s) * pixel_mm >= 1.0]
    middle = [np.mean(s, axis=0) - fork for s in stretches]
    wide = [float(np.median([width[p] for p in s])) for s in stretches]
    arms = [m for m, w in zip(middle, wide, strict=True) if w >= ARM_SHARE * max(wide)]
    straight = np.cos(np.radians(THROUGH_DEG))
    return any(
        a @ b < straight * np.linalg.norm(a) * np.linalg.norm(b)
        for i, a in enumerate(arms)
        for b in arms[:i]
    )
