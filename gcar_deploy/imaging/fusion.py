"""What the classical method and the network see of one picture, as one vessel image."""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.types import Mask


def fused(classic: VesselImage, learned: VesselImage) -> VesselImage:
    """Return the mean of both paths, and the mask that the network draws.

    Their errors have little in common: the one follows any line, however faint, and its contrast
    holds all that lies there; the other knows what a vessel looks like, at whatever size. The
    classical paths are first brought to the scale of the network's, which is the better known.

    Parameters
    ----------
    classic, learned : of the same picture

    Returns
    -------
    VesselImage ; its ``others`` are ``learned`` and ``classic``
    """
    ours, theirs = classic.path_mm.astype(np.float64), learned.path_mm.astype(np.float64)
    both = (ours > 0) & (theirs > 0)
    power = float((ours[both] ** 2).sum())
    scale = float((ours[both] * theirs[both]).sum()) / power if power > 0 else 1.0
    return dataclasses.replace(
        learned,
        path_mm=(0.5 * (scale * ours + theirs)).astype(np.float32),
        others=(learned, classic),
        catheter=_either(classic, learned, learned.mask),
        catheter_mm=max(classic.catheter_mm, learned.catheter_mm),
    )


def _either(classic: VesselImage, learned: VesselImage, mask: Mask) -> Mask:
    found = [view.catheter for view in (classic, learned) if view.catheter is not None]
    return np.logical_or.reduce([np.zeros_like(mask), *found]) & ~mask
