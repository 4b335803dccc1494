"""Lines that stand out on one side alone: rims of the diaphragm, of ribs, of shadows.

A vessel is darker than what lies on either side of it. The rim of a large shadow is so towards one
side only; flattened, it looks like a line all the same.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.imaging import enhance
from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.resample import resize
from gcar_deploy.imaging.segment import at_working_size
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


def one_sided(
    lines: Sequence[tuple[Mask, Mask]], picture: Image, holes: Mask, pixel_mm: float
) -> list[Mask]:
    """Find the stretches between forks of lines that stand out on one side alone.

    Parameters
    ----------
    lines : of one picture, each (rows, cols) bool, one pixel wide, and (rows, cols) bool, all that
        may be vessel there: no background
    picture : (rows, cols) float32, about linear in the path, vessels bright
    holes : (rows, cols) bool, pixels without picture
    pixel_mm : float, pixel size at the isocentre

    Returns
    -------
    per line (rows, cols) bool, a part of it
    """
    work, _, work_mm = at_working_size(picture, holes, pixel_mm)
    size, full = work.shape[::-1], picture.shape[::-1]
    blur = max(0.5, BLUR_MM / work_mm)
    smooth = cv2.GaussianBlur(work, (0, 0), blur)
    wide = 2 * max(1, round(WIDEST_MM / work_mm)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (wide, wide))
    top = cv2.morphologyEx(smooth, cv2.MORPH_TOPHAT, disc)
    higher = resize(np.asarray(top, dtype=np.float32), full)
    found = []
    for line, reach in lines:
        vessel = resize(reach.astype(np.float32), size) > 0
        rise = cv2.GaussianBlur(work - enhance.background(work, vessel, work_mm), (0, 0), blur)
        mean = resize(np.asarray(rise, dtype=np.float32), full)
        found.append(_lower_on_one_side(line, higher, mean, pixel_mm))
    return found


def _lower_on_one_side(line: Mask, higher: Image, mean: Image, pixel_mm: float) -> Mask:
    """Return the stretches by their rise above the higher side and above the mean of both."""
    count, label = skel.stretches(line)
    on = label > 0
    which, above_higher, above_mean = label[on], higher[on], mean[on]
    rims = np.zeros(count, bool)
    for k in range(1, count):
        here = which == k
        if here.sum() * pixel_mm >= SHORTEST_MM:
            least = SHARE * max(float(np.median(above_mean[here])), 0.0)
            rims[k] = np.median(above_higher[here]) < least
    return rims[label]
