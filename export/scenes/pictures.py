"""What reaches the predictor of a generated tree: exact, noisy, uncertain paths, or masks.

Each kind starts from the exact path lengths of fine pixels, as a detector would see them, and ends
in path lengths on pixels of about one lattice cell through the runtime's own code.
"""

from __future__ import annotations

import cv2
import numpy as np

from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.extract import CONTRAST_ERROR
from gcar_deploy.imaging.mask_path import mask_path
from gcar_deploy.imaging.widths import MASK_ERROR
from gcar_deploy.types import Array, Image, Mask

#: kinds of input with the relative error of their paths, as the runtime gives it
PATH_ERRORS = {
    "exact": 0.0,
    "noisy": 0.0,
    "uncertain": CONTRAST_ERROR,
    "mask": MASK_ERROR,
}
#: shortest path that a mask's pixel shows, mm
LEAST_MM = 0.02
#: of the smoothing that looks for vessels in noise, mm, and smallest part that is kept, mm^2
DETECT_MM, SMALLEST_MM2 = 0.35, 2.0


def with_noise(rng: np.random.Generator, path: Image, pixel_mm: float) -> Image:
    """Add Gaussian noise of 0.01 .. 0.2 mm or that of 1,000 .. 10,000 quanta; cut the background.

    Parameters
    ----------
    path : (rows, cols) mm
    pixel_mm : pixel size at the isocentre

    Returns
    -------
    (rows, cols) float32, mm, not negative; zero where nothing stands out of the noise
    """
    if rng.random() < 0.7:
        sigma = float(np.exp(rng.uniform(np.log(0.01), np.log(0.2))))
        noisy = path + sigma * rng.normal(size=path.shape)
    else:
        quanta, per_mm = rng.uniform(1e3, 1e4), rng.uniform(0.1, 0.2)
        sigma = 1 / (per_mm * np.sqrt(quanta))
        counts = np.maximum(rng.poisson(quanta * np.exp(-per_mm * path)), 0.5)
        noisy = -np.log(counts / quanta) / per_mm
    width = max(DETECT_MM / pixel_mm, 0.6)
    smooth = cv2.GaussianBlur(noisy, (0, 0), width)
    level = rng.uniform(2.5, 4.5) * sigma / (2 * np.sqrt(np.pi) * width)
    near = cv2.dilate((smooth > level).astype(np.uint8), np.ones((3, 3), np.uint8))
    seen = _large_parts(near, SMALLEST_MM2 / pixel_mm**2)
    return np.where(seen, np.maximum(noisy, 0), 0).astype(np.float32)


def _large_parts(mask: Array, least_px: float) -> Mask:
    _, label, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= least_px
    large[0] = False
    kept: Mask = large[label]
    return kept


def as_mask(rng: np.random.Generator, path: Image, pixel_mm: float, spoilt: bool) -> Image:
    """Path length that the tree's mask stands for, with a segmentation's errors if ``spoilt``."""
    mask = path > LEAST_MM
    if spoilt:
        mask = spoil(rng, mask, pixel_mm)
    return mask_path(mask, pixel_mm)


def spoil(rng: np.random.Generator, mask: Mask, pixel_mm: float) -> Mask:
    """Return what a segmentation makes of a mask: edges 1 .. 2 px off, gaps, cut ends, spurs."""
    if not mask.any():
        return mask
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    level = np.where(mask, inside - 0.5, 0.5 - outside)
    wander: Array = cv2.GaussianBlur(
        rng.normal(size=mask.shape).astype(np.float32), (0, 0), rng.uniform(1, 8)
    )
    wander *= rng.uniform(0, 0.9) / max(float(wander.std()), 1e-6)
    out = (level + wander + rng.uniform(-0.6, 1.0) > 0).astype(np.uint8)
    if rng.random() < 0.5:
        # Thin vessels survive a shrunken edge as broken lines in some hands, whole in others.
        out |= skel.skeletonize(mask)
    line = skel.skeletonize(mask)
    _erase(rng, out, line, rng.poisson(0.8), (1.2, 2.5), inside)
    ends = line & (skel.neighbours(line) == 1)
    reach = rng.uniform(1, 10) / pixel_mm
    _erase(
        rng, out, ends, rng.binomial(int(ends.sum()), rng.uniform(0, 0.4)), (1, 1), inside + reach
    )
    for _ in range(rng.poisson(1.5)):
        row, col = _one_of(rng, line)
        tip = np.array([col, row]) + rng.normal(size=2) * (inside[row, col] + 1.5 / pixel_mm)
        cv2.line(out, (col, row), (int(tip[0]), int(tip[1])), 1, int(rng.integers(1, 3)))
    return _large_parts(out, 6)


def _erase(
    rng: np.random.Generator, out: Array, where: Mask, count: int, scale: tuple[float, float],
    radius_px: Array,
) -> None:  # fmt: skip
    """Draw ``count`` empty discs at pixels of ``where``; their radius is scaled from a map."""
    for _ in range(count):
        row, col = _one_of(rng, where)
        radius = radius_px[row, col] * rng.uniform(*scale)
        cv2.circle(out, (int(col), int(row)), int(np.ceil(radius)), 0, -1)


def _one_of(rng: np.random.Generator, mask: Mask) -> tuple[int, int]:
    rows, cols = np.nonzero(mask)
    k = rng.integers(len(rows))
    return int(rows[k]), int(cols[k])


def degrade(rng: np.random.Generator, path: Image, h: float) -> Image:
    """Unknown contrast, blur, noise, a wandering mask, gaps: what grey values leave us.

    Parameters
    ----------
    path : (rows, cols) mm, pixels of about ``h`` mm
    """
    mask = (path > 0.3 * h).astype(np.uint8)
    out: Array = path.copy()
    if rng.random() < 0.5:
        # The calibre seen in the mask in place of the attenuation.
        width = 2 * cv2.distanceTransform(mask, cv2.DIST_L2, 3) * h
        out = out * (1 - (w := rng.uniform(0, 1))) + w * np.maximum(width - 0.5 * h, 0)
    out = cv2.GaussianBlur(out, (0, 0), rng.uniform(0.2, 0.9))
    noise: Array = cv2.GaussianBlur(
        rng.normal(size=path.shape).astype(np.float32), (0, 0), rng.uniform(0.5, 6)
    )
    noise *= rng.uniform(0, 0.3) / max(float(noise.std()), 1e-6)
    out = out * rng.uniform(0.7, 1.4) * np.exp(noise)
    out = out ** rng.uniform(0.8, 1.15)
    for _ in range(rng.poisson(1.0)):
        rows, cols = np.nonzero(mask)
        k = rng.integers(len(rows)) if len(rows) else 0
        if len(rows):
            cv2.circle(out, (int(cols[k]), int(rows[k])), int(rng.integers(1, 3)), 0.0, -1)
    out[out < rng.uniform(0.1, 0.5) * h] = 0.0
    return np.asarray(out, dtype=np.float32)
