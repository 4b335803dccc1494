"""Pictures whose pixels are longer one way, on square ones: widths are the same in every direction.

Blurs, distances to an edge and the footprints of tubes count pixels, whatever the way across a
vessel runs.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.resample import area_shares, averaged, stretched, weighted
from gcar_deploy.types import Mask

#: sides that differ by less are equal: the radius of a vessel is off by half of that
SQUARE_WITHIN = 0.01
#: square pixels are as fine as the shorter side, up to so many times as many pixels
MOST_MORE = 2.0


def square_scales(carm: CArm) -> tuple[float, float]:
    """Return how many times as many pixels (down, across) make them square; 1 where they are."""
    across, down = carm.focal_px  # pixels per unit of angle
    if abs(across / down - 1) < SQUARE_WITHIN:
        return 1.0, 1.0
    fine = min(max(across, down), math.sqrt(MOST_MORE * across * down))
    # The finer side stays as it is, to the last digit.
    return (1.0 if fine == down else fine / down), (1.0 if fine == across else fine / across)


def squared(angiogram: Angiogram) -> Angiogram:
    """Return the picture and all that was drawn in it on square pixels.

    They meet at the principal point (``resample.stretched``): a border more or less changes none.
    """
    scales = square_scales(angiogram.carm)
    if scales == (1.0, 1.0):
        return angiogram
    carm, down, across = stretched(angiogram.carm, scales)

    def drawn(mask: Mask | None) -> Mask | None:
        return None if mask is None else weighted(mask.astype(np.float32), down, across) >= 0.5

    pixels = weighted(angiogram.pixels, down, across)
    if angiogram.intensity.kind == "mask":
        # A mask has two values; which pixels are vessel is asked of it as it came.
        low, high = float(angiogram.pixels.min()), float(angiogram.pixels.max())
        pixels = np.where(pixels >= 0.5 * (low + high), np.float32(high), np.float32(low))
    return dataclasses.replace(
        angiogram,
        carm=carm,
        pixels=pixels,
        valid=drawn(angiogram.valid),
        mask=drawn(angiogram.mask),
        erased=drawn(angiogram.erased),
        painted=drawn(angiogram.painted),
        bare=tuple(weighted(frame, down, across) for frame in angiogram.bare),
        enlarged=angiogram.enlarged * max(scales),
    )


def square_point(carm: CArm, point: tuple[float, float] | None) -> tuple[float, float] | None:
    """Return where a point (col, row) of a view lies on its square pixels."""
    scales = square_scales(carm)
    if point is None or scales == (1.0, 1.0):
        return point
    middle, new = carm.principal_point, stretched(carm, scales)[0].principal_point
    column, row = (
        there + (at - here) * scale
        for there, at, here, scale in zip(new, point, middle, scales[::-1], strict=True)
    )
    return column, row


def on_given_pixels(found: VesselImage, carm: CArm) -> VesselImage:
    """Return what was found on the square pixels of a view on the pixels of the view itself.

    Parameters
    ----------
    found : VesselImage, as of a ``squared`` picture
    carm : the view that was ``squared``, to the last digit; the result has this one
    """
    scales = square_scales(carm)
    if scales == (1.0, 1.0):
        return dataclasses.replace(found, carm=carm)
    new = stretched(carm, scales)[0]
    # The old pixels' edges on the new ones.
    down, across = (
        area_shares(there + (np.arange(count + 1) - 0.5 - here) * scale, many)
        for there, here, scale, count, many in zip(
            new.principal_point[::-1], carm.principal_point[::-1], scales,
            (carm.rows, carm.columns), (new.rows, new.columns), strict=True,
        )
    )  # fmt: skip
    return averaged(found, carm, lambda picture: weighted(picture, down, across))
