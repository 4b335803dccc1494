"""Lines as they run: stretches of a skeleton, joined where they go straight on through forks.

A lead that crosses a vessel is one line before and after it, and a vessel with side branches is one
line past each of them: how a line runs tells what it is only over a long way.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from gcar_deploy.imaging.linegraph import LineGraph, Pixel
from gcar_deploy.types import Image, Mask

Stretch: TypeAlias = "list[Pixel]"
#: (number of a stretch, 0 for its first pixel or 1 for its last)
End: TypeAlias = "tuple[int, int]"
#: two lines that cross share a bridge between two forks: so many pixels, or so many widths long, as
#: they cross at an angle
BRIDGE_PX, _BRIDGE_WIDTHS = 8.0, 2.0
#: an arm heads for this pixel of it; two that turn by no more than this go on as one line
_ARM_PX = 12
STRAIGHT_DEG = 40.0


def chains(line: Mask, width_px: Image) -> list[Stretch]:
    """Return lines, each a list of pixels in their order; a stretch belongs to exactly one.

    Parameters
    ----------
    line : (rows, cols) bool, one pixel wide
    width_px : (rows, cols) float, width of what the line runs through, pixels

    Returns
    -------
    list of lists of (row, col)
        Without the bridges of crossings. Neighbours in a list may be apart by a bridge.
    """
    stretches, place = _cut(LineGraph(line), line, width_px)
    onward = _onward(stretches, place)
    out: list[Stretch] = []
    used = set[int]()
    for number in range(len(stretches)):
        if number in used:
            continue
        chain: Stretch = []
        end: End | None = _first(number, onward)
        while end is not None and end[0] not in used:
            used.add(end[0])
            chain += _from(stretches, end)
            end = onward.get((end[0], 1 - end[1]))
        out.append(chain)
    return out


def stretches_of(line: Mask) -> list[Stretch]:
    """Return the ways from one end or fork of a line to the next, and the rings that have none."""
    graph, pixels = LineGraph(line), _pixels(line)
    return _between(graph, pixels, {pixel for pixel in pixels if len(graph.joined(pixel)) != 2})


def _pixels(line: Mask) -> list[Pixel]:
    return [(int(row), int(column)) for row, column in np.argwhere(line)]


def _cut(graph: LineGraph, line: Mask, width_px: Image) -> tuple[list[Stretch], dict[Pixel, Pixel]]:
    """Return the stretches between forks and ends, and of each fork the place that it is part of.

    The bridge of a crossing is no stretch: its two forks are one place.
    """
    pixels = _pixels(line)
    nodes = {pixel for pixel in pixels if len(graph.joined(pixel)) != 2}
    forks = {pixel for pixel in nodes if len(graph.joined(pixel)) > 2}
    place = {fork: fork for fork in forks}

    def root(fork: Pixel) -> Pixel:
        while place[fork] != fork:
            fork = place[fork]
        return fork

    stretches: list[Stretch] = []
    for stretch in _between(graph, pixels, nodes):
        first, last = stretch[0], stretch[-1]
        bridge = max(BRIDGE_PX, _BRIDGE_WIDTHS * max(float(width_px[first]), float(width_px[last])))
        if first in forks and last in forks and first != last and len(stretch) <= bridge:
            place[root(first)] = root(last)
        else:
            stretches.append(stretch)
    return stretches, {fork: root(fork) for fork in forks}


def _between(graph: LineGraph, pixels: list[Pixel], nodes: set[Pixel]) -> list[Stretch]:
    """Return the ways from node to node, and the rings that have none."""
    found: list[Stretch] = []
    trod = set[tuple[Pixel, Pixel]]()
    for node in sorted(nodes):
        for first in graph.joined(node):
            if (node, first) in trod:
                continue
            way = _walk(graph, [node, first], nodes)
            trod |= {(node, first), (way[-1], way[-2])}
            found.append(way)
    seen = {pixel for way in found for pixel in way}
    for pixel in pixels:
        if pixel not in seen and graph.joined(pixel):
            ring = _walk(graph, [pixel, graph.joined(pixel)[0]], {pixel})
            seen.update(ring)
            found.append(ring[:-1])
    return found


def _walk(graph: LineGraph, way: Stretch, nodes: set[Pixel]) -> Stretch:
    while way[-1] not in nodes:
        way.append(next(p for p in graph.joined(way[-1]) if p != way[-2]))
    return way


def _onward(stretches: list[Stretch], place: dict[Pixel, Pixel]) -> dict[End, End]:
    """Return the end that each end goes on at, where one does: the straightest pairs first."""
    arms: dict[Pixel, list[End]] = {}
    for number, stretch in enumerate(stretches):
        for side in (0, 1):
            at = place.get(stretch[-side])
            if at is not None:
                arms.setdefault(at, []).append((number, side))
    onward: dict[End, End] = {}
    for ends in arms.values():
        ways = [_heading(_from(stretches, end)) for end in ends]
        pairs = sorted((float(ways[i] @ ways[j]), j, i) for i in range(len(ends)) for j in range(i))
        for cosine, j, i in pairs:
            one, other = ends[i], ends[j]
            if cosine > -math.cos(math.radians(STRAIGHT_DEG)):
                break
            if one not in onward and other not in onward and one[0] != other[0]:
                onward[one], onward[other] = other, one
    return onward


def _first(number: int, onward: dict[End, End]) -> End:
    """Where the line that a stretch belongs to begins: its end that nothing goes on at."""
    end, seen = (number, 0), {number}
    while end in onward:
        before = onward[end]
        if before[0] in seen:
            break
        seen.add(before[0])
        end = (before[0], 1 - before[1])
    return end


def _from(stretches: list[Stretch], end: End) -> Stretch:
    stretch = stretches[end[0]]
    return stretch if end[1] == 0 else stretch[::-1]


def _heading(arm: Stretch) -> np.ndarray:
    """(2,) unit vector that an arm leaves its fork in; 0 for a single pixel."""
    far = arm[min(_ARM_PX, len(arm) - 1)]
    way = np.subtract(far, arm[0], dtype=float)
    return way / max(float(np.hypot(*way)), 1e-9)
