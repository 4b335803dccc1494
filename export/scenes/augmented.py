"""A picture with its truth, used many times: turned, bent, zoomed, regraded, made noisy.

Drawing a generated angiogram takes as long as learning from it, and real ones are few: each is
used many times and never twice the same.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from gcar_deploy.imaging.skeleton import skeletonize
from gcar_deploy.types import Array, Image
from gcar_export.scenes.angiograms import SIDE, network_input

#: of ten crops this many lie straight; the others are turned by up to so much
STRAIGHT, TURN_DEG = 4, 40.0
#: a smooth displacement: scale, and standard deviation as a share of it
_WAVE_PX, _WAVE_SHARE = (14.0, 40.0), 0.1


@dataclasses.dataclass(frozen=True, eq=False)
class Labelled:
    """One picture, dark vessels, and what is asked of it.

    Attributes
    ----------
    pixels : (rows, cols) grey values
    asked : (6, rows, cols) float32, as the truth of ``angiograms.training_pair``
    zoom : smallest and largest enlargement
    """

    pixels: Array
    asked: Array
    zoom: tuple[float, float]


def augmented_pair(
    rng: np.random.Generator, given: Labelled, side: int = SIDE, turn_deg: float = TURN_DEG
) -> tuple[Array, Array]:
    """Return the network's input and truth of a crop, as ``angiograms.training_pair`` does.

    ``side``: of the crop, pixels; ``turn_deg``: it is turned by no more.
    """
    maps, inside, zoom = _placed(rng, given, side, turn_deg)
    pixels = cv2.remap(
        np.asarray(given.pixels, np.float32), *maps, cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT_101,
    )  # fmt: skip
    smooth, nearest = (
        [cv2.remap(np.ascontiguousarray(given.asked[k]), *maps, how) for k in layers]
        for layers, how in (((0, 2), cv2.INTER_LINEAR), ((1, 3, 4), cv2.INTER_NEAREST))
    )
    mask, path = smooth[0] >= 0.5, smooth[1] * np.float32(zoom)
    weight, device, known = nearest
    device = np.where(mask, 0, device)
    channels, holes = network_input(_regraded(rng, np.asarray(pixels, np.float32)))
    truth = np.stack([mask, weight, path, device, known, skeletonize(mask)]).astype(np.float32)
    truth[:, ~inside | holes] = 0.0
    return channels, truth


def _placed(
    rng: np.random.Generator, given: Labelled, side: int, turn_deg: float
) -> tuple[tuple[Image, Image], Array, float]:
    """Where each pixel of the crop comes from (col, row), whether it exists, the enlargement."""
    rows, columns = given.pixels.shape
    zoom = float(np.exp(rng.uniform(*np.log(given.zoom))))
    turned = rng.integers(10) >= STRAIGHT
    angle = np.radians(rng.uniform(-turn_deg, turn_deg) if turned else 0.0)
    linear = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) / zoom
    linear[:, 0] *= rng.choice([-1, 1])
    linear[:, 1] *= rng.choice([-1, 1])
    if rng.integers(2):
        linear = linear[:, ::-1]
    # The crop lies within the picture as far as it can.
    free = np.maximum(np.array([columns, rows]) - side / zoom, 0.0) / 2
    middle = np.array([columns - 1, rows - 1]) / 2 + rng.uniform(-1, 1, 2) * free
    row, col = np.indices((side, side), dtype=np.float32) - (side - 1) / 2
    if rng.integers(2):
        scale = rng.uniform(*_WAVE_PX)
        for part in (col, row):
            part += np.float32(rng.uniform(0, _WAVE_SHARE) * scale) * _smooth(rng, side, scale)
    x = (linear[0, 0] * col + linear[0, 1] * row + middle[0]).astype(np.float32)
    y = (linear[1, 0] * col + linear[1, 1] * row + middle[1]).astype(np.float32)
    return (x, y), (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1), zoom


def _smooth(rng: np.random.Generator, side: int, scale: float) -> Image:
    """(side, side) noise of unit variance; ``side`` a multiple of 8."""
    coarse = rng.standard_normal((side // 8, side // 8)).astype(np.float32)
    noise = cv2.resize(cv2.GaussianBlur(coarse, (0, 0), scale / 8), (side, side))
    return np.asarray(noise / noise.std(), np.float32)


def _regraded(rng: np.random.Generator, pixels: Image) -> Image:
    """Bend the grey values, shade, blur or sharpen, add noise, at times through JPEG."""
    top = max(float(pixels.max()), 1.0)
    out = (np.clip(pixels, 0, None) / np.float32(top)) ** np.float32(np.exp(rng.normal(0, 0.3)))
    if rng.random() < 0.3:
        out = out * np.exp(
            np.float32(rng.uniform(0, 0.2)) * _smooth(rng, len(out), rng.uniform(20, 60))
        )
    if rng.random() < 0.5:
        wide = cv2.GaussianBlur(out, (0, 0), rng.uniform(0.5, 3.0))
        out = out + np.float32(rng.uniform(-0.7, 1.0)) * (out - wide)
    if rng.random() < 0.5:
        grain = rng.normal(0, rng.uniform(0.003, 0.035), out.shape).astype(np.float32)
        if rng.random() < 0.5:
            grain = 1.8 * cv2.GaussianBlur(grain, (0, 0), rng.uniform(0.4, 0.9))
        out = out + grain
    low, high = rng.uniform(0, 50), rng.uniform(180, 255)
    grey = np.clip(low + (high - low) * out, 0, 255).round().astype(np.uint8)
    if rng.random() < 0.2:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.uniform(40, 95))]
        grey = cv2.imdecode(cv2.imencode(".jpg", grey, quality)[1], cv2.IMREAD_UNCHANGED)
    return np.asarray(grey, dtype=np.float32)
