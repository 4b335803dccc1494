"""Path lengths from contrast: the rise above the filled-in background, on a scale of its own."""

from __future__ import annotations

import cv2
import numpy as np

from gcar_deploy.imaging import enhance
from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.types import Image, Mask

#: beyond the rim is what has less than this share of the contrast of the nearest centreline: noise
#: that is never below 0 would widen the vessel. Chosen on generated pairs; 0.4 makes vessels thin
RIM_SHARE = 0.25
#: the contrast is blurred for that question by so much, and averaged along the line, mm; pixels
#: where these are coarse
_BLUR_MM, _ALONG_MM = 0.3, 1.2
_LEAST_BLUR_PX, _LEAST_ALONG_PX = 0.5, 2.0


def scaled_contrast(
    picture: Image, holes: Mask, vessel: Mask, known_mm: Image, pixel_mm: float
) -> Image:
    """Contrast of vessels on the scale of paths that are known roughly.

    Parameters
    ----------
    picture : (rows, cols) float32, about linear in the path, vessels bright
    holes : (rows, cols) bool, pixels without picture
    vessel : (rows, cols) bool, all that may be vessel: no background
    known_mm : (rows, cols) float32, mm, 0 where nothing is known; its scale is taken over
    pixel_mm : float, pixel size at the isocentre

    Returns
    -------
    (rows, cols) float32, mm, 0 outside ``vessel`` and beyond the rim (``RIM_SHARE``); ``known_mm``
    where there is no contrast at all
    """
    rise = enhance.rise(picture, holes, vessel, pixel_mm)
    both = vessel & (known_mm > 0)
    c, q = rise[both].astype(np.float64), known_mm[both].astype(np.float64)
    if not c.any():
        return known_mm
    # Both are off: a regression of one on the other would make the paths too short.
    scale = np.float32(np.sqrt((q * q).sum() / (c * c).sum()))
    path = np.where(vessel, rise * scale, np.float32(0))
    line = skel.skeletonize(vessel)
    smooth = cv2.GaussianBlur(path, (0, 0), max(_BLUR_MM / pixel_mm, _LEAST_BLUR_PX))
    _, (peak,) = skel.spread(line, (smooth,), max(_ALONG_MM / pixel_mm, _LEAST_ALONG_PX))
    return np.where((smooth > RIM_SHARE * peak) | line, path, np.float32(0))
