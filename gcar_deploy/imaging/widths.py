"""What widths say of path lengths: alone, or with a word beside contrast.

Contrast fails in clouds, where a display cuts off the darkest grey values, and in front of what is
as dark as a vessel; widths where vessels overlap, run along the ray, or are as thin as a pixel.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.mask_path import mask_path
from gcar_deploy.types import Image, Mask

#: relative error of a path from the width of a mask: its edges are off by a part of a pixel, a
#: vessel seen at a slant is thicker than it is wide, and overlaps show one of two vessels
MASK_ERROR = 0.3
#: weight of widths beside contrast, whose errors are smaller and of another origin. Chosen on
#: generated pictures with dark clouds and displays of all kinds; 0.45 loses on the ten real trees
WIDTH_SHARE = 0.3
#: no path is changed by more than this factor; shorter ones are noise, mm
_MOST_CHANGED, _LEAST_MM = 2.0, 1e-3
#: both are blurred by so much and averaged along the line, mm; pixels where these are coarse
_BLUR_MM, _ALONG_MM = 0.3, 1.5
_LEAST_BLUR_PX, _LEAST_ALONG_PX = 0.5, 2.0


def by_width(view: VesselImage) -> VesselImage:
    """Return the view with the chords of its mask for paths: its contrast is not believed."""
    return dataclasses.replace(
        view,
        path_mm=mask_path(view.mask, view.carm.pixel_at_isocenter_mm),
        path_error=MASK_ERROR,
        kind="mask",
        others=(),
        kept=None,
    )


def own_widths(view: VesselImage) -> VesselImage:
    """Let widths have a word about the paths of a picture whose vessels the network drew."""
    if not view.by_network or view.kind == "mask" or not view.mask.any():
        return view
    path_mm = tempered(view.path_mm, view.mask, view.carm.pixel_at_isocenter_mm)
    return dataclasses.replace(view, path_mm=path_mm)


def others_too(view: VesselImage) -> VesselImage:
    """After ``own_widths`` let them have it about ``others``, and what it would be with devices."""
    others, kept = tuple(own_widths(other) for other in view.others), view.kept
    kept_too = None if kept is None else lambda: own_widths(kept())
    return dataclasses.replace(view, others=others, kept=kept_too)


def tempered(path_mm: Image, mask: Mask, pixel_mm: float) -> Image:
    """Paths by contrast where widths have a word.

    In the middle of the vessels the weighted geometric mean of both; the scale (median) and the
    profile across stay those of contrast.

    Parameters
    ----------
    path_mm : (rows, cols) float32, mm, by contrast
    mask : (rows, cols) bool, whose widths are asked
    pixel_mm : float, pixel size at the isocentre

    Returns
    -------
    (rows, cols) float32, mm, 0 where ``path_mm`` is
    """
    line = skel.skeletonize(mask)
    along = max(_ALONG_MM / pixel_mm, _LEAST_ALONG_PX)
    blur = max(_BLUR_MM / pixel_mm, _LEAST_BLUR_PX)
    smooth = tuple(cv2.GaussianBlur(p, (0, 0), blur) for p in (path_mm, mask_path(mask, pixel_mm)))
    _, (contrast, width) = skel.spread(line, smooth, along)
    told = line & (contrast > _LEAST_MM) & (width > _LEAST_MM)
    if not told.any():
        return path_mm
    ratio = np.log(np.maximum(width, _LEAST_MM) / np.maximum(contrast, _LEAST_MM))
    factor = np.exp(WIDTH_SHARE * (ratio - np.median(ratio[told])))
    return np.asarray(path_mm * np.clip(factor, 1 / _MOST_CHANGED, _MOST_CHANGED), np.float32)
