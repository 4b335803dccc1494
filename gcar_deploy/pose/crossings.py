"""How often lines cross the epipolar planes: a vessel does so as often in one view as in the other.

However wide it is and however its contrast reads, so that a thin catheter counts as much as the
artery that it fills. What one view alone shows crosses planes too often there.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.consistency import BIN_MM, HALF_BINS
from gcar_deploy.geometry.epipolar import plane_axes, reach_mm, slices_along
from gcar_deploy.types import Array, Mask, Pixels, Scalars

#: crossings are smoothed over so much across the planes, since hearts move, mm
SMOOTH_MM = 2.0
#: lines that cross fewer planes than fill this say little, mm
LITTLE_MM = 3.0
#: pixels of a line are drawn to the mean of those so near, odd
STRAIGHT_PX = 7


class Surplus:
    """How many of a line's crossings another view lacks.

    Parameters
    ----------
    line : (rows, cols) bool, all lines of the view, one pixel wide
    carm : of the view
    other, other_carm : lines and geometry of the other view

    Raises
    ------
    GeometryError
        As ``plane_axes``.
    """

    def __init__(self, line: Mask, carm: CArm, other: Mask, other_carm: CArm) -> None:
        self._axes, self._reach = plane_axes(carm, other_carm), reach_mm(carm, other_carm)
        self._carm = carm
        self._more = self._crossings(carm, line) - self._crossings(other_carm, other)

    def share(self, part: Mask) -> float:
        """-1 .. 1 of a (rows, cols) bool part of the line: 1 where the other view has none of it.

        -1 where it has all; 0 also of a line that runs along the planes.
        """
        own = self._crossings(self._carm, part)
        less = np.abs(self._more).sum() - np.abs(self._more - own).sum()
        return float(less / (own.sum() + LITTLE_MM / BIN_MM))

    def _crossings(self, carm: CArm, line: Mask) -> Scalars:
        """(bins,) how often a line crosses the planes of each bin, smoothed."""
        pixels, steps = _steps(line)
        first, second = (slices_along(self._axes, carm, pixels)[0] * self._reach / BIN_MM)[steps]
        middle = (0.5 * (first + second) + HALF_BINS).astype(np.int64)
        at = np.minimum(np.maximum(middle, 0), 2 * HALF_BINS)
        count = np.bincount(at, np.abs(first - second), 2 * HALF_BINS + 1)
        smooth: Scalars = gaussian_filter1d(count, SMOOTH_MM / BIN_MM, mode="constant")
        return smooth


def _steps(line: Mask) -> tuple[Pixels, Array]:
    """(n, 2) (col, row) of a line's pixels, and (2, m) which are neighbours.

    Places are means over ``STRAIGHT_PX``: a slanted row of pixels goes back and forth across the
    planes. Round a corner its sides alone count.
    """
    rows, columns = line.shape
    row, col = np.nonzero(line)
    box = STRAIGHT_PX, STRAIGHT_PX
    shown = line.astype(np.float32)
    near = cv2.blur(shown, box)[row, col]
    grid = np.zeros((2, rows, columns), np.float32)
    grid[:, row, col] = col, row
    mean = np.stack([cv2.blur(one, box)[row, col] / near for one in grid], axis=1)
    number = np.full(line.shape, -1)
    number[row, col] = np.arange(len(row))
    out = []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        below, beside = row + down, col + right
        there = np.flatnonzero((below < rows) & (beside >= 0) & (beside < columns))
        there = there[line[below[there], beside[there]]]
        if down and right:
            corner = line[row[there], beside[there]] | line[below[there], col[there]]
            there = there[~corner]
        out.append(np.stack([there, number[below[there], beside[there]]]))
    return mean.astype(np.float64), np.concatenate(out, axis=1)
