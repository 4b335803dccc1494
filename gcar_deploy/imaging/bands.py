"""Ribs and other bands that the network takes for vessels: far less deep than they are wide.

All vessels of a picture hold the same contrast medium, so that contrast grows with width alike.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.imaging import enhance
from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.distance import exact_distance
from gcar_deploy.imaging.net import Seen
from gcar_deploy.types import Image, Mask

#: half width of what may be a band, at least, and of the vessels that it is held against, at most,
#: mm. Wires and letters among those say nothing of contrast medium: what is likelier a device than
#: this is left out
_WIDE_MM, _NARROW_MM, _DEVICE = 3.0, 2.5, 0.5
#: a band has less than this share of their contrast for its width
_SHARE = 0.25
#: contrast is averaged over so much of a line, pixels
_ALONG_PX = 3.0


def without_bands(
    seen: Seen, reach: Mask, line: Mask, told: Image, picture: Image, holes: Mask, pixel_mm: float
) -> Seen:
    """Take probability from lines that are no vessels by their contrast.

    Parameters
    ----------
    seen : Seen
    reach, line : (rows, cols) bool, where lines are seen, and their centrelines
    told : (rows, cols) float32, how probably a line is a device
    picture : (rows, cols) float32, about linear in the path, vessels bright
    holes : (rows, cols) bool, pixels without picture
    pixel_mm : float, about the size of a pixel at the isocentre

    Returns
    -------
    Seen, the very one that was given where nothing is a band
    """
    half = exact_distance(reach) * np.float32(pixel_mm)
    narrow = line & (half < _NARROW_MM) & (told < _DEVICE)
    if not narrow.any() or not (line & (half > _WIDE_MM)).any():
        return seen
    rise = enhance.rise(picture, holes, reach, pixel_mm)
    _, (along,) = skel.spread(line, (rise,), _ALONG_PX)
    per_width = along / np.maximum(half, 1e-6)
    least = _SHARE * float(np.median(per_width[narrow]))
    count, label = skel.stretches(line)
    numbers, widths, depths = label[line], half[line], per_width[line]
    bands = np.zeros(count, bool)
    for k in range(1, count):
        own = numbers == k
        wide = float(np.median(widths[own]))
        # What is shorter than it is wide lies between two vessels that nearly touch.
        long = own.sum() * pixel_mm >= 2 * wide
        bands[k] = long and wide > _WIDE_MM and np.median(depths[own]) < least
    if not bands.any():
        return seen
    gone = skel.beside_alone(reach, line, bands[label])
    return dataclasses.replace(seen, probability=np.where(gone, np.float32(0), seen.probability))
