"""Lines that are catheters, leads, wires, or borders of what lies behind: no vessels.

A network is asked along the lines, not pixel by pixel: a vessel that crosses a lead stays whole,
and a device is one over a long way.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.line_strips import SHORTEST_PX, line_points
from gcar_deploy.imaging.net import SIDE, Seen, Segmenter
from gcar_deploy.types import Array, Image, Mask

#: hysteresis on the probability: what is less probable than this share of the level ends a device
ENDS = 0.6
#: a line goes on from an end so near to it, where it turns by no more over so much of its way and
#: is no more times as wide or as narrow
_NEAR_MM, _TURN_DEG, _WAY_MM, _AS_WIDE = 2.5, 25.0, (3.0, 6.0), 1.5
#: what joins so many ends of lines, and lines that go on so, is part of them. Of 313 parts of
#: generated pictures (seeds 88001, 88002, 91101, 91102, 91202) 10 join three, all of them vessels,
#: and 17 go on at two, 14 of them vessels
_JOINS, _GOES_ON = 3, 2


def device_map(
    segmenter: Segmenter, channels: Array, seen: Seen, line: Mask, reach: Mask, holes: Mask
) -> Image:
    """(rows, cols) float32, 0 .. 1, that the nearest line is of a device; 0 outside ``reach``.

    Parameters
    ----------
    segmenter : Segmenter, whose network of lines is asked
    channels : (3, rows, cols) float32, from ``net.net_input``
    seen : what it saw in them
    line : (rows, cols) bool, one pixel wide
    reach : (rows, cols) bool, what the line is the middle of
    holes : (rows, cols) bool, pixels without picture

    Raises
    ------
    ModelError, NumericalError, CancelledError
        As ``Segmenter.devices``.
    """
    shape = line.shape
    scale = SIDE / float(np.sqrt(line.size))
    found = line_points(*_at_side(channels, seen, line, _outside(holes), scale))
    if not len(found.pixels):
        return np.zeros(shape, np.float32)
    said = segmenter.devices(found)
    row, column = np.clip(np.rint(found.pixels / scale), 0, np.subtract(shape, 1)).astype(int).T
    # Where lines cross, a vessel goes on.
    on_line = np.full(shape, 2.0, np.float32)
    np.minimum.at(on_line, (row, column), said)
    away = (on_line > 1).astype(np.uint8)
    _, label = cv2.distanceTransformWithLabels(away, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    of_label = np.zeros(int(label.max()) + 1, np.float32)
    of_label[label[away == 0]] = on_line[away == 0]
    return np.where(reach, of_label[label], np.float32(0))


def _outside(holes: Mask) -> Mask:
    """(rows, cols) bool: holes from the picture's border on; what was erased within is none."""
    frame = np.ones_like(holes)
    frame[1:-1, 1:-1] = False
    return skel.parts_touching(holes, holes & frame)


def _at_side(
    channels: Array, seen: Seen, line: Mask, holes: Mask, scale: float
) -> tuple[Array, Mask, Mask]:
    """Bring maps, line and holes to the size that the network of lines learned at."""
    maps = np.concatenate([channels, seen.probability[None], seen.chord[None]])
    if abs(scale - 1) < 0.02:
        return maps, line, holes
    size = tuple(max(1, round(n * scale)) for n in line.shape[::-1])
    maps = np.stack([cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in maps])
    maps[4] *= np.float32(scale)
    thick = cv2.resize(line.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
    fewer = cv2.resize(holes.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    return maps, skel.skeletonize(thick), fewer


def device_parts(line: Mask, device: Image, level: float, finer: float = 1.0) -> Iterator[Mask]:
    """Yield parts of a line that are devices, the surest first, each (rows, cols) bool.

    Parameters
    ----------
    line : (rows, cols) bool, one pixel wide
    device : (rows, cols) float32, probability of a device, 0 .. 1
    level : float, of the probability somewhere on the part
    finer : float, pixels for one of the network's
    """
    own = skel.parts_touching(line & (device >= ENDS * level), line & (device >= level))
    count, label = cv2.connectedComponents(own.astype(np.uint8), connectivity=8)
    weight = np.bincount(label[own], device[own], count)
    length = np.bincount(label[own], minlength=count)
    for k in np.argsort(-weight, kind="stable"):
        if k and length[k] >= SHORTEST_PX * finer:
            yield label == k


def is_between(part: Mask, rest: Mask, half: Image, pixel_mm: float) -> bool:
    """Whether a part of a line is one with what is left: no device, or all of it is one.

    It joins three ends of the rest, or at two ends the rest goes on straight and as wide.

    Parameters
    ----------
    part : (rows, cols) bool, of the line
    rest : (rows, cols) bool, the line without all that may be a device
    half : (rows, cols) float32, half the width of what the line is the middle of, pixels
    pixel_mm : float
    """
    own, others = np.argwhere(part), np.argwhere(rest)
    label = cv2.connectedComponents(rest.astype(np.uint8), connectivity=8)[1][rest]
    width, joins, going = float(np.median(half[part])), 0, 0
    for end in np.argwhere(part & (skel.neighbours(part) <= 1)):
        far = pixel_mm * np.linalg.norm(own - end, axis=1)
        before = own[(far > _WAY_MM[0] - 1) & (far < _WAY_MM[1] - 1)]
        ahead = others - end
        far = pixel_mm * np.linalg.norm(ahead, axis=1)
        near = far <= _NEAR_MM
        joins += bool(near.any())
        if not len(before) or not near.any():
            continue
        on = np.isin(label, label[near]) & (far > _WAY_MM[0]) & (far < _WAY_MM[1])
        way = end - before.mean(axis=0)
        along = pixel_mm * (ahead[on] @ way) / max(float(np.linalg.norm(way)), 1e-9)
        straight = others[on][along >= np.cos(np.radians(_TURN_DEG)) * far[on]]
        if len(straight):
            wider = float(np.median(half[tuple(straight.T)])) / max(width, 1e-9)
            going += 1 / _AS_WIDE <= wider <= _AS_WIDE
    return joins >= _JOINS or going >= _GOES_ON
