"""Connected parts of what was found in a picture."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from gcar_deploy.imaging.angiogram import VesselImage


def largest_part(view: VesselImage) -> VesselImage:
    """Return the view with the largest 8-connected part of its vessels alone.

    Returns
    -------
    VesselImage, the same object where there is only one part or none
    """
    count, label, stats, _ = cv2.connectedComponentsWithStats(
        (view.mask | (view.path_mm > 0)).astype(np.uint8), connectivity=8
    )
    if count <= 2:
        return view
    inside = label == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    return dataclasses.replace(
        view,
        mask=view.mask & inside,
        skeleton=view.skeleton & inside,
        path_mm=np.where(inside, view.path_mm, np.float32(0)),
    )
