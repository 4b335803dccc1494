"""Distance to the nearest pixel that is not set, the same at any number of threads."""

from __future__ import annotations

import cv2
import numpy as np

from gcar_deploy.types import Image, Mask


def exact_distance(inside: Mask) -> Image:
    """(rows, cols) float32 distance of each set pixel to the nearest other one, pixels.

    OpenCV's own answer differs in its last digit with the number of threads that share the rows,
    and a busy pool is one thread. Squares of distances are whole numbers, which tells it.
    """
    found = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(np.sqrt(np.rint(found * found)))
