"""Masks that were thinned to centrelines: they tell where vessels run, not how wide they are."""

from __future__ import annotations

import cv2
import numpy as np

from gcar_deploy.errors import RefusedError
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.types import Mask

#: of a line one pixel wide hardly a pixel is part of a full square of 2 x 2: only where lines meet
MOST_SQUARES = 0.2
#: in coarser pictures vessels are honestly one pixel wide, mm at the isocentre
COARSE_MM = 0.8
#: fewer pixels than this say nothing of lines
_FEWEST = 30
_SQUARE = np.ones((2, 2), np.uint8)


def refuse_thin(angiogram: Angiogram, mask: Mask) -> None:
    """Refuse a mask of lines one pixel wide: paths follow from the width of its vessels.

    Raises
    ------
    RefusedError
        Hardly any pixel of the mask has vessel on two sides.
    """
    count = int(mask.sum())
    if angiogram.carm.pixel_at_isocenter_mm > COARSE_MM or count < _FEWEST:
        return
    wide = int(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _SQUARE).sum())
    if wide <= MOST_SQUARES * count:
        raise RefusedError(
            f"{angiogram.label}: the mask's lines are one pixel wide; "
            "a mask (kind mask) has to show the vessels as wide as they are in the picture"
        )
