"""Path lengths with noise: how much there is, and where vessel stands out of it.

Calibrated pictures come without noise (simulated) or with it (subtracted and scaled). A threshold
belongs to the noise of the picture at hand: measured beside the vessels, after as much blur as the
thinnest vessels bear.
"""

from __future__ import annotations

import cv2
import numpy as np

from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.types import Image, Mask

#: blur before the threshold, mm at the isocentre: less than the radius of the thinnest vessels
BLUR_MM = 0.25
#: ... and narrower than this it does nothing, pixels
LEAST_BLUR_PX = 0.35
#: noise is what so many of its deviations reach beyond a given threshold
MATTERS = 5.0
#: vessel: hysteresis at so many deviations above the middle of the background
LOW, HIGH = 3.5, 5.5
#: room left round vessels where the background is measured, mm at the isocentre and pixels
ROOM_MM, ROOM_PX = 1.0, 2
#: deviation as a multiple of the median difference between neighbours: 1.05 of normal noise, twice
#: that where half of it is cut off
FIRST_GUESS = 2.0
#: rounds of measuring and leaving out what stands out
ROUNDS = 4
#: fewer pixels make no statistics
ENOUGH = 100
#: share of a normal distribution below one deviation above its middle
ONE_SIGMA = 0.8413


def vessels_in_noise(
    path: Image, valid: Mask, pixel_mm: float, smallest: float
) -> tuple[Mask, float] | None:
    """Find vessel in path lengths with noise.

    Parameters
    ----------
    path : (rows, cols) float32, mm, 0 or more: noise below 0 may have been cut off
    valid : (rows, cols) bool, pixels that carry a picture
    pixel_mm : float, pixel size at the isocentre
    smallest : float, path that is vessel where there is no noise, mm

    Returns
    -------
    (rows, cols) bool and the noise's deviation, mm, or None where it does not come near
    ``smallest``
    """
    _, noise = _background(path, valid, pixel_mm)
    if MATTERS * noise <= smallest:
        return None
    blur = BLUR_MM / pixel_mm
    seen = path
    if blur > LEAST_BLUR_PX:
        seen = np.asarray(cv2.GaussianBlur(path, (0, 0), blur), dtype=np.float32)
    middle, deviation = _background(seen, valid, pixel_mm)
    low, high = (middle + many * deviation for many in (LOW, HIGH))
    strong = (seen > max(high, smallest)) & valid
    return skel.parts_touching((seen > max(low, smallest)) & valid, strong), noise


def _background(picture: Image, valid: Mask, pixel_mm: float) -> tuple[float, float]:
    """Middle and deviation beside the vessels; 0, 0 without noise.

    The deviation is that upwards: noise may be cut off at 0.
    """
    room = 2 * max(ROOM_PX, round(ROOM_MM / pixel_mm)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (room, room))
    # Neighbours differ by the noise wherever there is no vessel: wide vessels do not count.
    middle = float(np.median(picture[valid])) if valid.any() else 0.0
    deviation = FIRST_GUESS * float(np.median(np.abs(np.diff(picture, axis=1))))
    for _ in range(ROUNDS if deviation > 0 else 0):
        vessel = skel.parts_touching(
            picture > middle + LOW * deviation, picture > middle + HIGH * deviation
        )
        beside = picture[valid & (cv2.dilate(vessel.astype(np.uint8), disc) == 0)]
        if len(beside) < ENOUGH:
            break
        middle, upper = (float(x) for x in np.quantile(beside, (0.5, ONE_SIGMA)))
        deviation = upper - middle
    return middle, deviation
