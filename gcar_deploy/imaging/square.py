"""Pictures whose pixels are longer one way, on square ones: widths are the same in every direction.

Blurs, distances to an edge and the footprints of tubes count pixels, whatever the way across a
vessel runs.
"""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.resample import resized
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


def as_taken(view: VesselImage, carm: CArm) -> VesselImage:
    """Return what was found on square pixels on those of ``carm``, of the same field."""
    if view.mask.shape == (carm.rows, carm.columns):
        return view
    return resized(view, carm.rows, carm.columns)


def _resampled(picture: Image, shape: tuple[int, int]) -> Image:
    """Means where pixels grow, linear between their middles where they shrink."""
    for axis in (0, 1):
        old, new = picture.shape[axis], shape[axis]
        size = (picture.shape[1], new) if axis == 0 else (new, picture.shape[0])
        way = cv2.INTER_AREA if new < old else cv2.INTER_LINEAR
        picture = cv2.resize(picture, size, interpolation=way).astype(np.float32, copy=False)
    return picture
