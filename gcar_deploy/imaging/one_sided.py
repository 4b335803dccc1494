"""Lines that stand out on one side alone: rims of the diaphragm, of ribs, of shadows.

A vessel is darker than what lies on either side of it. The rim of a large shadow is so towards one
side only; flattened, it looks like a line all the same.
"""

from __future__ import annotations

import cv2
import numpy as np

from gcar_deploy.imaging import enhance
from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.segment import at_working_size, resize
from gcar_deploy.types import Image, Mask

#: wider than any vessel, blur included: a disc of this radius finds room on the higher side, mm
WIDEST_MM = 3.5
#: a stretch is a rim where its rise above the higher side is less than this share of its rise above
#: the mean of both. Of 44 generated pairs (three seeds) 2 % of the true length and half of the
#: false one lie below; of the 40 real pictures 9 % of what experts drew, so that it is a question
#: for the views and no rule
SHARE = 0.6
#: stretches shorter than this are not asked; both rises are blurred by so much, mm
SHORTEST_MM, BLUR_MM = 6.0, 0.5
_BLOCK = np.ones((3, 3), np.uint8)


def one_sided(line: Mask, reach: Mask, picture: Image, holes: Mask, pixel_mm: float) -> Mask:
    """Return the stretches between forks of a line that stand out on one side alone.

    Parameters
    ----------
    line : (rows, cols) bool, one pixel wide
    reach : (rows, cols) bool, all that may be vessel: no background
    picture : (rows, cols) float32, about linear in the path, vessels bright
    holes : (rows, cols) bool, pixels without picture
    pixel_mm : float, pixel size at the isocentre

    Returns
    -------
    (rows, cols) bool, a part of ``line``
    """
    work, _, work_mm = at_working_size(picture, holes, pixel_mm)
    size = work.shape[::-1]
    vessel = resize(reach.astype(np.float32), size) > 0
    blur = max(0.5, BLUR_MM / work_mm)
    smooth = cv2.GaussianBlur(work, (0, 0), blur)
    wide = 2 * max(1, round(WIDEST_MM / work_mm)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (wide, wide))
    higher = smooth - cv2.morphologyEx(smooth, cv2.MORPH_OPEN, disc)
    mean = cv2.GaussianBlur(work - enhance.background(work, vessel, work_mm), (0, 0), blur)
    full = line.shape[::-1]
    higher, mean = (resize(np.asarray(rise, dtype=np.float32), full) for rise in (higher, mean))
    forks = line & (skel.neighbours(line) >= 3)
    stretches = line & (cv2.dilate(forks.astype(np.uint8), _BLOCK) == 0)
    count, label = cv2.connectedComponents(stretches.astype(np.uint8), connectivity=8)
    out = np.zeros_like(line)
    for k in range(1, count):
        here = label == k
        if here.sum() * pixel_mm >= SHORTEST_MM:
            out |= here & (np.median(higher[here]) < SHARE * max(float(np.median(mean[here])), 0.0))
    return out
