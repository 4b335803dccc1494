"""Lines that the network of devices takes for catheters, leads or wires.

It is asked along lines, not pixel by pixel: a vessel that crosses a lead stays whole, and a device
is one over a long way. What counts comes from the border of the field, or hangs on nothing else,
and is no side branch of a vessel that goes on: vessels leave the field as well.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import cv2
import numpy as np

from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.border import inward_px
from gcar_deploy.types import Image, Mask

#: the probability is averaged over so much of the line; shorter devices are none; so near to the
#: border one comes from outside, all in pixels of the network
ALONG_PX, SHORTEST_PX, BORDER_PX = 5.0, 24, 10.0
#: what joins a line whose two arms, so far from there, are straight to so much is a side branch;
#: so much of it may be left over up to there
ARM_PX, STRAIGHT_DEG, STUB_PX = (5.0, 10.0), 35.0, 25.0
_BLOCK = np.ones((3, 3), np.uint8)
#: what is less probable than this share of the level ends a device
_ENDS = 0.7


def device_parts(
    line: Mask, device: Image, valid: Mask | None, level: float, finer: float = 1.0
) -> Iterator[Mask]:
    """Yield parts of a line that are a device, each (rows, cols) bool.

    Parameters
    ----------
    line : (rows, cols) bool, one pixel wide
    device : (rows, cols) float32, probability of a device, 0 .. 1
    valid : (rows, cols) bool, the field; None: a part may lie anywhere in the tree
    level : float, mean probability along the line somewhere on it
    finer : float, pixels for one of the network
    """
    if not line.any():
        return
    _, (mean,) = skel.spread(line, (device,), ALONG_PX * finer)
    sure = line & (mean >= level)
    if not sure.any():
        return
    own = skel.parts_touching(line & (mean >= _ENDS * level), sure)
    other = cv2.dilate((line & ~own).astype(np.uint8), _BLOCK) > 0
    near = np.ones_like(line) if valid is None else inward_px(valid) <= BORDER_PX * finer
    count, label = cv2.connectedComponents(own.astype(np.uint8), connectivity=8)
    for k in range(1, count):
        part = label == k
        if part.sum() < SHORTEST_PX * finer:
            continue
        if valid is not None and _side_branch(_to_fork(part, line, finer), line, finer):
            continue
        if (part & near).any() or not (part & other).any():
            yield part


def _to_fork(part: Mask, line: Mask, finer: float) -> Mask:
    """Part with what is left of its line to the next fork, if that is hardly any."""
    count, label = skel.stretches(line)
    left = np.bincount(label[line & ~part], minlength=count)
    mine = np.bincount(label[part], minlength=count) > 0
    short = mine & (left <= STUB_PX * finer)
    short[0] = False
    return part | short[label]


def _side_branch(part: Mask, line: Mask, finer: float) -> bool:
    """Whether the rest of the line goes straight on past the place where a part joins it."""
    rest = line & ~part
    touch = cv2.dilate(part.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    count, label = cv2.connectedComponents((rest & touch).astype(np.uint8), connectivity=8)
    row, column = np.nonzero(rest)
    for k in range(1, count):
        at = np.argwhere(label == k).mean(axis=0)
        away = np.hypot(row - at[0], column - at[1]) / finer
        arms = np.zeros_like(rest)
        ring = (away >= ARM_PX[0]) & (away <= ARM_PX[1])
        arms[row[ring], column[ring]] = True
        number, which = cv2.connectedComponents(arms.astype(np.uint8), connectivity=8)
        ways = [np.argwhere(which == n).mean(axis=0) - at for n in range(1, number)]
        ways = [way / max(float(np.hypot(*way)), 1e-9) for way in ways]
        straight = -math.cos(math.radians(STRAIGHT_DEG))
        if any(a @ b < straight for a, b in itertools.combinations(ways, 2)):
            return True
    return False
