"""Large grey pictures are searched with fewer pixels: the lines are the same, the time is not.

Filters cost what a picture has of pixels, and the network sees ``net.SIDE`` of them across anyway.
What is found is carried back to the pixels that were given, so that nobody else has to know.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.resample import resize
from gcar_deploy.types import Image, Mask

#: a picture is searched with at least so many pixels along its longer side, and fewer than twice
SEARCHED_SIDE = 512


def coarser(angiogram: Angiogram) -> Angiogram:
    """Return a picture with pixels so many times as large as leave ``SEARCHED_SIDE`` across.

    A picture of less than twice that side is returned as it is. Without what was drawn in it.
    """
    factor = searched_factor(angiogram.pixels.shape)
    if factor == 1:
        return angiogram
    pixels, valid = smaller(angiogram.pixels, factor), angiogram.valid
    return dataclasses.replace(
        angiogram,
        carm=angiogram.carm.resized(*pixels.shape),
        pixels=pixels,
        valid=None if valid is None else smaller(valid.astype(np.float32), factor) > 0.5,
        erased=None,
        painted=None,
        bare=tuple(smaller(one, factor) for one in angiogram.bare),
    )


def as_fine(found: VesselImage, angiogram: Angiogram) -> VesselImage:
    """Return what was found in ``coarser(angiogram)`` on the pixels of the picture itself."""
    shape, kept = angiogram.pixels.shape, found.kept
    if found.mask.shape == shape:
        return found
    mask = inside(found.mask, shape)
    catheter = None if found.catheter is None else inside(found.catheter, shape) & ~mask
    return dataclasses.replace(
        found,
        carm=angiogram.carm,
        path_mm=resize(found.path_mm, shape[::-1]),
        mask=mask,
        skeleton=skel.skeletonize(mask),
        valid=inside(found.valid, shape),
        vesselness=None if found.vesselness is None else resize(found.vesselness, shape[::-1]),
        catheter=catheter,
        device=None if found.device is None else resize(found.device, shape[::-1]),
        others=tuple(as_fine(other, angiogram) for other in found.others),
        kept=None if kept is None else lambda: as_fine(kept(), angiogram),
    )


def searched_factor(shape: tuple[int, ...]) -> int:
    """How many times as large the pixels are that a picture of ``shape`` is searched with."""
    return max(max(shape) // SEARCHED_SIDE, 1)


def smaller(picture: Image, factor: int) -> Image:
    """Mean of a picture over pixels about ``factor`` times as large, a whole number of them."""
    rows, columns = picture.shape
    size = (max(1, columns // factor), max(1, rows // factor))
    return resize(picture, size)


def inside(mask: Mask, shape: tuple[int, ...]) -> Mask:
    """Pixels of a larger ``shape`` (rows, columns) whose centres lie in a coarser mask."""
    covered: Mask = resize(mask.astype(np.float32), shape[::-1]) > 0.5
    return covered
