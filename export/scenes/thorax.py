"""X-ray pictures of vessels before a chest of another make than ``raw_pictures``.

Ribs are wide bands with soft edges, clouds come at three scales, and vessels blur in the light, not
in its logarithm. Displays take the logarithm, the light or a power of it, and may sharpen edges.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.special import expit

from gcar_deploy.types import Array, Image

#: clouds: their size, mm, and the standard deviation of their attenuation
_CLOUDS = ((25.0, 0.35), (8.0, 0.12), (3.0, 0.05))


def thorax(shape: tuple[int, int], pixel_mm: float, rng: np.random.Generator) -> Array:
    """(rows, cols) attenuation of all that is no vessel: clouds, ribs, spine, diaphragm."""
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]] * pixel_mm
    high, wide = shape[0] * pixel_mm, shape[1] * pixel_mm
    out = np.zeros(shape)
    for size, deviation in _CLOUDS:
        small = gaussian_filter(
            rng.normal(size=(shape[0] // 4 + 1, shape[1] // 4 + 1)), size / pixel_mm / 4
        )
        cloud = cv2.resize(small / small.std(), shape[::-1], interpolation=cv2.INTER_CUBIC)
        out += deviation * rng.uniform(0.3, 1) * cloud
    if rng.random() < 0.7:
        slope, bow = rng.uniform(-0.6, 0.6), 0.0015 * (x - 80) ** 2
        for k in range(-3, 9):
            off = y - k * rng.uniform(18, 24) - rng.uniform(-3, 3) - slope * x - bow
            out += expit((rng.uniform(4, 6) - np.abs(off)) / 0.7) * rng.uniform(0.03, 0.12)
    if rng.random() < 0.6:
        out += expit((16 - np.abs(x - rng.uniform(0, wide) + 0.1 * y)) / 2) * rng.uniform(0.1, 0.4)
    if rng.random() < 0.5:
        dome = high * rng.uniform(0.7, 1.1) + 0.002 * (x - rng.uniform(20, 120)) ** 2
        out += expit((y - dome) / rng.uniform(0.8, 3)) * rng.uniform(0.2, 0.6)
    return out


def exposure(
    path_mm: Image, catheter_mm: Image | None, pixel_mm: float, rng: np.random.Generator
) -> Image:
    """Expose and display a picture.

    Parameters
    ----------
    path_mm : (rows, cols) through vessels
    catheter_mm : (rows, cols) through a catheter filled with contrast, None without one
    pixel_mm : float, at the isocentre
    rng : draws all that varies

    Returns
    -------
    (rows, cols) float32, whole numbers 0 .. 255, vessels dark
    """
    shape = (path_mm.shape[0], path_mm.shape[1])
    attenuation = rng.uniform(0.035, 0.14) * path_mm + thorax(shape, pixel_mm, rng)
    if catheter_mm is not None:
        attenuation = attenuation + rng.uniform(0.05, 0.16) * catheter_mm
    light = cv2.GaussianBlur(np.exp(-attenuation), (0, 0), 0.6 * rng.uniform(0.3, 0.6) / pixel_mm)
    noise = np.sqrt(light / 10 ** rng.uniform(2.7, 4.5))
    light = cv2.GaussianBlur(light + noise * rng.normal(size=shape), (0, 0), rng.uniform(0.25, 0.7))
    shown = _displayed(np.maximum(light, 1e-3), pixel_mm, rng)
    low, high = np.percentile(shown, [rng.uniform(0.01, 1), rng.uniform(99, 99.95)])
    counts = np.round(255 * np.clip((shown - low) / (high - low), 0, 1))
    if rng.random() < 0.4:
        edge = int(min(shape) * rng.uniform(0, 0.04))
        counts[:edge], counts[:, :edge] = 0, 0
        if rng.random() < 0.5:
            y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
            away = np.hypot(y - shape[0] / 2, x - shape[1] / 2)
            counts[away > 0.5 * max(shape) * rng.uniform(1, 1.15)] = 0
    return np.asarray(counts, dtype=np.float32)


def _displayed(light: Array, pixel_mm: float, rng: np.random.Generator) -> Array:
    """(rows, cols) grey values of some display, any scale."""
    law = rng.integers(3)
    shown: Array = (
        np.log(light) if law == 0 else light ** (1 if law == 1 else rng.uniform(0.5, 1.3))
    )
    if rng.random() < 0.35:
        smooth = cv2.GaussianBlur(shown, (0, 0), rng.uniform(1, 4) / pixel_mm)
        shown = shown + rng.uniform(0.5, 2) * (shown - smooth)
    return shown
