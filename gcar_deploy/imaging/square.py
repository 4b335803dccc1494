"""Pictures whose pixels are longer one way, on square ones: widths are the same in every direction.

Blurs, distances to an edge and the footprints of tubes count pixels, whatever the way across a
vessel runs.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.imaging.resample import resize
from gcar_deploy.types import Image, Mask

#: sides that differ by less are equal: the radius of a vessel is off by half of that
SQUARE_WITHIN = 0.01
#: square pixels are as fine as the shorter side, up to so many times as many pixels
MOST_MORE = 2.0


def square_shape(carm: CArm) -> tuple[int, int]:
    """Return (rows, columns) of the view on square pixels; its own where they are."""
    across, down = carm.focal_px  # pixels per unit of angle
    if abs(across / down - 1) < SQUARE_WITHIN:
        return carm.rows, carm.columns
    fine = min(max(across, down), math.sqrt(MOST_MORE * across * down))
    return max(round(carm.rows * fine / down), 1), max(round(carm.columns * fine / across), 1)


def squared(angiogram: Angiogram) -> Angiogram:
    """Return the picture and all that was drawn in it on square pixels, over the same field."""
    shape = square_shape(angiogram.carm)
    if shape == angiogram.pixels.shape:
        return angiogram

    def drawn(mask: Mask | None) -> Mask | None:
        return None if mask is None else _resampled(mask.astype(np.float32), shape) >= 0.5

    pixels = _resampled(angiogram.pixels, shape)
    if angiogram.intensity.kind == "mask":
        # A mask has two values; which pixels are vessel is asked of it as it came.
        low, high = float(angiogram.pixels.min()), float(angiogram.pixels.max())
        pixels = np.where(pixels >= 0.5 * (low + high), np.float32(high), np.float32(low))
    return dataclasses.replace(
        angiogram,
        carm=angiogram.carm.resized(*shape),
        pixels=pixels,
        valid=drawn(angiogram.valid),
        mask=drawn(angiogram.mask),
        erased=drawn(angiogram.erased),
        painted=drawn(angiogram.painted),
        bare=tuple(_resampled(frame, shape) for frame in angiogram.bare),
    )


def square_point(carm: CArm, point: tuple[float, float] | None) -> tuple[float, float] | None:
    """Return where a point (col, row) of a view lies on its square pixels."""
    rows, columns = square_shape(carm)
    if point is None or (rows, columns) == (carm.rows, carm.columns):
        return point
    column, row = point
    return (
        (column + 0.5) * columns / carm.columns - 0.5,
        (row + 0.5) * rows / carm.rows - 0.5,
    )


def _resampled(picture: Image, shape: tuple[int, int]) -> Image:
    """Resample to (rows, columns): one way may shrink while the other grows."""
    rows, columns = shape
    return resize(resize(picture, (picture.shape[1], rows)), (columns, rows))
