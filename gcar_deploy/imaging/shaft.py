"""A catheter's shaft by its course alone: long, even, smooth, unbranched and from the border.

A shaft is drawn to one width and bends as a stiff tube does; a vessel tapers and wriggles. Over
a long enough way that tells them apart even where the vessel that follows is hardly wider, or
where the line ends before the ostium.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from gcar_deploy.imaging.linegraph import LineGraph, Pixel
from gcar_deploy.types import Image, Scalars

#: a shaft is followed so far, and is at least so long, mm
LONGEST_MM, SHORTEST_MM = 160.0, 30.0
#: a side branch shorter than this is a spur, mm
SPUR_MM = 8.0
#: it ends where its width is off that of the way before by this share, over ``_OFF_MM``
OFF_SHARE = 0.2
#: standard deviation of its width as a share of it, and how much its halves differ
UNEVENNESS, TAPER = 0.12, 0.05
#: widest one, blur included, mm, and as a share of the 90th percentile of all widths
WIDEST_MM, WIDEST_SHARE = 4.2, 0.7
#: standard deviation of its curvature, 1/mm
WRIGGLE = 0.04
#: the end at the border is blurred with it; widths are medians of so much line; from here on they
#: are compared; and how long they have to be off, mm
_SKIP_MM, _MEDIAN_MM, _FROM_MM, _OFF_MM = 2.0, 4.5, 10.0, 4.0
#: blur of the course before its direction is taken, and of the direction, mm
_SMOOTH_MM, _TURN_MM = 2.0, 1.5


def shaft(
    graph: LineGraph, end: Pixel, width: Image, widest: float, pixel_mm: float
) -> list[Pixel]:
    """Pixels from ``end`` that are a shaft by their course; none where they are no such.

    Parameters
    ----------
    graph : LineGraph
    end : Pixel, near the border of the field
    width : (rows, cols) float32, mm, of the line that is nearest
    widest : float, mm, 90th percentile of the line's widths
    pixel_mm : float
    """
    px = 1.0 / pixel_mm
    path, _ = graph.walk(end, SPUR_MM * px, LONGEST_MM * px)
    if len(path) < SHORTEST_MM * px:
        return []
    wide = width[tuple(np.transpose(path))].astype(np.float64)
    count = _even(wide, px)
    own = wide[round(_SKIP_MM * px) : count]
    if count < SHORTEST_MM * px or not _drawn_to_one(own, widest):
        return []
    if _wriggle(np.asarray(path[:count], dtype=np.float64), px) > WRIGGLE:
        return []
    return path[:count]


def _even(wide: Scalars, px: float) -> int:
    """How many of the widths come before they change for good."""
    local = ndimage.median_filter(wide, max(3, round(_MEDIAN_MM * px)), mode="nearest")
    skip, off = round(_SKIP_MM * px), 0
    for k in range(round(_FROM_MM * px), len(wide)):
        so_far = float(np.median(wide[skip : k - skip]))
        off = off + 1 if abs(local[k] - so_far) > OFF_SHARE * so_far else 0
        if off >= _OFF_MM * px:
            return k - off
    return len(wide)


def _drawn_to_one(wide: Scalars, widest: float) -> bool:
    """Whether the widths are those of a drawn tube."""
    low, own, high = np.quantile(wide, (0.15, 0.5, 0.85))
    first, second = (float(np.median(half)) for half in np.array_split(wide, 2))
    return bool(
        own <= min(WIDEST_MM, WIDEST_SHARE * widest)
        and 0.5 * (high - low) <= UNEVENNESS * own
        and abs(second - first) <= TAPER * first
    )


def _wriggle(path: Scalars, px: float) -> float:
    """Return the standard deviation of the curvature, 1/mm, of (n, 2) pixels."""
    smooth = ndimage.gaussian_filter1d(path, _SMOOTH_MM * px, axis=0, mode="nearest")
    blunt = round(_SMOOTH_MM * px)  # the ends of a blurred course are drawn together
    step = np.diff(smooth[blunt : len(smooth) - blunt], axis=0)
    angle = np.unwrap(np.arctan2(step[:, 0], step[:, 1]))
    return float(np.diff(ndimage.gaussian_filter1d(angle, _TURN_MM * px)).std()) * px
