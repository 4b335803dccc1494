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
