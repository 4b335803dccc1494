"""Where a collimator leaves a picture dark: straight and round shutters."""

from __future__ import annotations

import cv2
import numpy as np

from gcar_deploy.imaging import coarse
from gcar_deploy.types import Array, Image, Mask

#: a collimator shuts off no more of a picture than this
MOST_SHUT = 0.6
#: it is round where so many of its rim's places lie on one circle, to this share of the side
ROUND_POINTS, ROUND_SHARE, CIRCLE_ROUNDS = 0.7, 0.01, 6
#: ... and beyond it no more of the picture than this was not found
ROUND_WEDGES = 0.12


def collimator(pixels: Image, *, negative: bool = False) -> Mask:
    """(rows, cols) bool: dark, even areas that reach the border, wider than any vessel.

    Of a negative, bright ones.
    """
    if negative:
        pixels = pixels.max() - pixels
    factor = coarse.searched_factor(pixels.shape)
    if factor == 1:
        return _collimator(pixels)
    return coarse.inside(_collimator(coarse.smaller(pixels, factor)), pixels.shape)


def _collimator(pixels: Image) -> Mask:
    rows, columns = pixels.shape
    side = min(rows, columns)
    smooth = cv2.GaussianBlur(pixels, (0, 0), max(1.0, side / 150))
    middle, low = float(np.median(smooth)), float(np.percentile(smooth, 0.1))
    level = low + 0.25 * (middle - low)
    dark = (smooth < level).astype(np.uint8)
    reach = round(side * 0.05) | 1
    # Continue the picture outwards, or the opening would eat the corners.
    padded = cv2.copyMakeBorder(dark, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    opened = cv2.morphologyEx(padded, cv2.MORPH_OPEN, disc)[reach:-reach, reach:-reach]
    _, label, stats, _ = cv2.connectedComponentsWithStats(opened)
    x, y, wide, high, area = stats.T
    at_border = (x == 0) | (y == 0) | (x + wide == columns) | (y + high == rows)
    chosen = at_border & (area > 0.004 * rows * columns)
    chosen[0] = False
    for i in np.flatnonzero(chosen):
        chosen[i] = _step(smooth, label == i, reach) > 0.35 * (middle - low)
    found = chosen[label]
    if found.mean() > MOST_SHUT:  # a dark picture, not a border
        return np.zeros_like(found)
    grow = max(3, round(side * 0.03)) | 1
    grown = cv2.dilate(found.astype(np.uint8), np.ones((grow, grow), np.uint8)) > 0
    circle = _circle(found)
    if circle is None:
        return grown
    row, column = np.indices(found.shape, dtype=np.float32)
    off = np.hypot(row - circle[0], column - circle[1]) - circle[2]
    # Near the border a round shutter leaves wedges that are no wide areas; what lies beyond a dark
    # corner is the picture.
    if (~found & (off > 0)).mean() < ROUND_WEDGES:
        grown |= off > -0.5 * grow
    return grown


def _circle(found: Mask) -> tuple[float, float, float] | None:
    """Row and column of the middle and radius of a round shutter, None of any other."""
    inside = cv2.erode(found.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    at = np.argwhere(found & ~inside).astype(np.float64)
    tolerance = ROUND_SHARE * min(found.shape)
    used, fit = np.ones(len(at), bool), np.zeros(3)
    for _ in range(CIRCLE_ROUNDS):
        if used.sum() < 32:
            return None
        # |x - m|^2 = r^2 is linear in m and in r^2 - |m|^2 (Kasa 1976).
        terms = np.column_stack([2 * at, np.ones(len(at))])
        fit = np.linalg.lstsq(terms[used], (at[used] ** 2).sum(axis=1), rcond=None)[0]
        radius = float(np.sqrt(max(fit[2] + fit[0] ** 2 + fit[1] ** 2, 0.0)))
        off = np.abs(np.hypot(*(at - fit[:2]).T) - radius)
        used = off < max(tolerance, float(np.median(off)))
    if (off < tolerance).mean() < ROUND_POINTS:
        return None
    return float(fit[0]), float(fit[1]), radius


def _step(smooth: Array, area: Mask, reach: int) -> float:
    """Rise of the grey value across the rim of ``area``: a shutter is sharp, a shadow is not."""
    inside = cv2.copyMakeBorder(area.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    outward = cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)[1:-1, 1:-1]
    inward = cv2.distanceTransform(inside, cv2.DIST_L2, 5)[1:-1, 1:-1]
    rings = [(d > 0.2 * reach) & (d < 0.7 * reach) for d in (outward, inward)]
    if not (rings[0].any() and rings[1].any()):
        return 0.0
    return float(np.median(smooth[rings[0]]) - np.median(smooth[rings[1]]))
