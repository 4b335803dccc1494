"""A line along a vessel or catheter between two clicks, and how wide it is."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import ndimage
from skimage.graph import route_through_array

from gcar_deploy.errors import UsageError
from gcar_deploy.imaging import enhance
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.grey_values import bright_vessels
from gcar_deploy.imaging.polarity import is_dark
from gcar_deploy.types import Array, Image

#: the way may leave the straight line by this share of its length, and so many pixels
_ROOM, _LEAST_ROOM = 0.5, 30
#: widths of structures that are followed, pixels
_SCALES = (1.5, 3.0, 5.0)
#: a pixel off every line costs so many times what one on the clearest line does
_OFF = 40.0
#: a stroke covers the structure and its blurred edge
_WIDER = 1.5


def trace(
    angiogram: Angiogram, found: VesselImage | None, ends: tuple[Array, Array]
) -> dict[str, Any]:
    """Follow the clearest line between two places of a picture.

    Parameters
    ----------
    angiogram : the picture
    found : what was found in it, None where nobody looked
    ends : (column, row) of both clicks

    Returns
    -------
    ``points``, [column, row] along the line, and ``width_px``

    Raises
    ------
    UsageError
        A click lies outside the picture.
    """
    shape = np.array(angiogram.pixels.shape)
    first, last = (np.rint(end[::-1]).astype(int) for end in ends)
    if (np.minimum(first, last) < 0).any() or (np.maximum(first, last) >= shape).any():
        raise UsageError("a point lies outside its picture")
    room = int(_ROOM * np.linalg.norm(last - first)) + _LEAST_ROOM
    low = np.maximum(np.minimum(first, last) - room, 0)
    high = np.minimum(np.maximum(first, last) + room + 1, shape)
    part = (slice(low[0], high[0]), slice(low[1], high[1]))
    lines, scale = _ridges(bright_picture(angiogram)[part])
    if found is not None:
        lines[found.mask[part]] = np.maximum(lines[found.mask[part]], 0.5)
    way, _ = route_through_array(
        1.0 / (1.0 / _OFF + lines), tuple(first - low), tuple(last - low), geometric=True
    )
    path = np.array(way)
    width = 2 * _WIDER * float(np.median(scale[tuple(path.T)]))
    keep = np.unique([*range(0, len(path), 3), len(path) - 1])
    points = (path[keep] + low)[:, ::-1]
    return {"points": points.tolist(), "width_px": round(max(width, 3.0), 1)}


def bright_picture(angiogram: Angiogram) -> Image:
    """(rows, cols) the picture with its vessels bright, without what lies behind them."""
    kind = angiogram.intensity.kind
    if kind in ("path_length", "mask"):
        return angiogram.pixels
    pictures, _ = bright_vessels(angiogram.pixels, kind, is_dark(angiogram))
    return enhance.searched(pictures)


def _ridges(picture: Image) -> tuple[Image, Image]:
    """(rows, cols) how clear a bright line passes, 0 .. 1, and its standard deviation, pixels."""
    best = np.zeros(picture.shape, np.float32)
    scale = np.full(picture.shape, _SCALES[0], np.float32)
    for sigma in _SCALES:
        rr, rc, cc = (
            sigma**2 * ndimage.gaussian_filter(picture, sigma, order=order)
            for order in ((2, 0), (1, 1), (0, 2))
        )
        across = 0.5 * (rr + cc) - np.sqrt(0.25 * (rr - cc) ** 2 + rc**2)
        strength = np.maximum(-across, 0)
        better = strength > best
        best[better], scale[better] = strength[better], sigma
    top = float(np.percentile(best, 99))
    return np.clip(best / max(top, 1e-12), 0, 1), scale
