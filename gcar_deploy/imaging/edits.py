"""Vessels as they were found, less what the user erased, with what the user painted."""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.errors import RefusedError
from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.mask_path import mask_path

#: a picture of path lengths tells of vessel from so many mm on: below it shows none, or noise
LEAST_TOLD_MM = 0.2


def edited(found: VesselImage, angiogram: Angiogram) -> VesselImage:
    """Apply the strokes of a picture to its vessels.

    What is erased holds no vessel: its path is 0, which the fit believes. What is painted is
    vessel as thick as it is wide, except where a picture of path lengths tells the path itself.

    Parameters
    ----------
    found : VesselImage of ``angiogram``
    angiogram : Angiogram with ``erased``, ``painted``, or both

    Raises
    ------
    RefusedError
        Nothing is left.
    """
    erased, painted, kept = angiogram.erased, angiogram.painted, found.kept
    if erased is None and painted is None:
        return found
    nowhere = np.zeros(found.mask.shape, bool)
    erased = nowhere if erased is None else erased
    painted = nowhere if painted is None else painted & found.valid
    mask = (found.mask & ~erased) | painted
    line, path = found.skeleton & ~erased, np.where(erased, np.float32(0), found.path_mm)
    if painted.any():
        new = painted & (path <= 0)
        drawn = mask_path(mask, angiogram.carm.pixel_at_isocenter_mm)
        scale = angiogram.intensity.mm_per_count
        if found.kind == "path_length" and scale is not None:
            told = angiogram.pixels * np.float32(scale)
            drawn = np.where(told > LEAST_TOLD_MM, told, drawn)
        path = np.where(new, drawn, path)
        # Lines elsewhere stay as they were found; where paint meets them they are drawn anew.
        line = np.where(painted, skel.skeletonize(mask), line)
    if not line.any():
        raise RefusedError(f"no vessel is left in view {found.view_id} after what was erased")
    return dataclasses.replace(
        found,
        mask=mask,
        skeleton=line,
        path_mm=np.asarray(path, dtype=np.float32),
        painted=painted if painted.any() else None,
        others=tuple(edited(other, angiogram) for other in found.others),
        kept=None if kept is None else lambda: edited(kept(), angiogram),
    )
