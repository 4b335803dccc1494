"""Vessels on an even ground, as other programs draw them: no filter is needed to see them.

A rendered tree, or a mask saved as a grey picture, has nothing beside its vessels: half of the
pixels are one grey value. What stands out of it is vessel, to the rim, however thin or wide.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.segment import PART_SHARE
from gcar_deploy.types import Image, Mask

#: the ground is even if the robust standard deviation of all pixels is at most this share of the
#: deepest vessels, and hardly any pixel stands out the other way
_SPREAD, _OTHER_WAY = 0.03, 0.02
#: what stands out by so many deviations, and by this share of the deepest, is no ground
_DEVIATIONS, _LEAST = 4.0, 0.02
#: the rim of a vessel, as a share of its middle: where a round vessel is 0.98 of its radius away
RIM_SHARE = 0.2
#: shadows are lines: at most so much of the picture, and no half-width over this share of its side
_AREA, _HALF_WIDTH = 0.3, 0.06
#: a shadow is flat where this share of it is nearly as dark as its darkest part
_FLAT_SHARE, _NEARLY = 0.8, 0.9
#: middles are averaged over so much of the line, pixels
_ALONG_PX = 3.0


@dataclasses.dataclass(frozen=True, eq=False)
class Shadow:
    """Vessels on an even ground.

    Attributes
    ----------
    mask : (rows, cols) bool
    flat : bool, of one grey value: it shows where vessels are and nothing of their depth
    """

    mask: Mask
    flat: bool


def shadow(picture: Image, holes: Mask) -> Shadow | None:
    """Return the vessels of a picture whose ground is even, None of any other picture.

    Parameters
    ----------
    picture : (rows, cols) float32, vessels bright, any scale and offset
    holes : (rows, cols) bool, pixels without picture
    """
    if holes.all():
        return None
    seen = picture[~holes].astype(np.float64)
    ground = float(np.median(seen))
    rise = np.where(holes, 0.0, picture - ground).astype(np.float32)
    deepest = float(np.percentile(rise, 99.9))
    spread = 1.4826 * float(np.median(np.abs(seen - ground)))
    if deepest <= 0 or spread > _SPREAD * deepest:
        return None
    floor = max(_DEVIATIONS * spread, _LEAST * deepest)
    if float((rise < -floor).mean()) > _OTHER_WAY:
        return None
    reach = rise > floor
    line = skel.skeletonize(reach)
    half_width = cv2.distanceTransform(reach.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    wide = half_width.max() > _HALF_WIDTH * min(picture.shape)
    if not line.any() or reach.mean() > _AREA or wide:
        return None
    kept = skel.strong_parts(line, rise, PART_SHARE)
    _, (peak,) = skel.spread(line, (rise,), _ALONG_PX)
    mask = ((rise > RIM_SHARE * peak) | kept) & skel.beside(reach, line, kept)
    dark = rise[mask] >= _NEARLY * deepest
    return Shadow(mask, bool(dark.mean() >= _FLAT_SHARE))
