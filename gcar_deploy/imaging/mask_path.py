"""Chords of round vessels from a mask alone: what a segmentation tells of path lengths.

A mask shows no brightness, but a vessel is nearly round: its chord follows from the width of its
shadow. Training and deployment share this file, so they cannot drift apart.
"""

from __future__ import annotations

import cv2
import numpy as np

from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.distance import exact_distance
from gcar_deploy.types import Image, Mask

#: the edge is drawn between pixels: so many parts of a pixel ...
PARTS = 4
#: ... but finer than this shows nothing more of a vessel, mm at the isocentre
FINEST_MM = 0.12
#: Gaussian that rounds the stairs of the mask's edge, pixels of the mask; a line one pixel wide
#: keeps more than half of its height
EDGE_SIGMA_PX = 0.6
#: radii are averaged over so many pixels along the line: an edge is off by a part of a pixel
ALONG_SIGMA_PX = 1.5
#: mean chord over the pixel of a vessel that is one pixel wide, pixels
THINNEST_PX = np.pi / 4


def mask_path(mask: Mask, pixel_mm: float) -> Image:
    """Path length that a mask of round vessels stands for.

    The mask is smoothed on finer pixels, which puts its edge between its own. The radius of a
    vessel is the mean, over its section, of the distance to its centreline and the distance to
    that edge together; at a distance d from the centreline a vessel of radius R is
    2 sqrt(R^2 - d^2) thick. Where two vessels overlap, the mask shows one
    of them: the wider.

    Parameters
    ----------
    mask : (rows, cols) bool, vessel
    pixel_mm : float, pixel size at the isocentre

    Returns
    -------
    (rows, cols) float32, mm, mean over the pixel; above 0 on the mask's centreline, 0 outside the
    mask
    """
    out = np.zeros(mask.shape, np.float32)
    if not mask.any():
        return out
    parts = int(np.clip(np.ceil(pixel_mm / FINEST_MM), 2, PARTS))
    inside = np.argwhere(mask)
    # Only the box of the vessels is looked at, with room for the blur.
    (r0, c0), (r1, c1) = inside.min(axis=0), inside.max(axis=0) + 1
    box = np.pad(mask[r0:r1, c0:c1], 3)
    path = _chords(box, parts)
    # A line thinner than what the smoothing leaves is a vessel still.
    line = skel.skeletonize(box)
    path = np.where(line, np.maximum(path, np.float32(THINNEST_PX)), path)
    out[r0:r1, c0:c1] = path[3:-3, 3:-3] * np.float32(pixel_mm)
    return np.where(mask, out, np.float32(0))


def _chords(box: Mask, parts: int) -> Image:
    """(rows, cols) float32 mean chord, pixels, of a mask with an empty border."""
    rows, cols = box.shape
    fine = np.repeat(np.repeat(box.astype(np.float32), parts, axis=0), parts, axis=1)
    vessel = cv2.GaussianBlur(fine, (0, 0), EDGE_SIGMA_PX * parts) > 0.5
    line = skel.skeletonize(vessel)
    if not line.any():
        return np.zeros(box.shape, np.float32)
    # to the centre of the first pixel outside, half a pixel too far
    edge = exact_distance(vessel) - 0.5
    distance, radius = skel.averaged(line, vessel, edge, ALONG_SIGMA_PX * parts)
    # In a fork the nearest line may be that of the thinner vessel.
    radius = np.maximum(radius, edge)
    chord = 2 * np.sqrt(np.clip(radius**2 - distance**2, 0, None))
    chord = np.where(vessel, chord, np.float32(0)) / np.float32(parts)
    mean = cv2.resize(chord, (cols, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(mean, dtype=np.float32)
