"""How near points of a tree come to marked pixels of a view."""

from __future__ import annotations

import numpy as np

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.distance import exact_distance
from gcar_deploy.types import Array, Mask


def distance_mm(view: VesselImage, points_mm: Array, marked: Mask, *, beyond: bool) -> Array:
    """(n,) distance of reprojected points from marked pixels, mm at the isocentre.

    Parameters
    ----------
    view : of the picture
    points_mm : (n, 3) mm LPS
    marked : (rows, columns) bool
    beyond : whether all beyond the picture is marked as well; else points there are at infinity,
        as all are where nothing is marked
    """
    free = np.pad(~marked, 1, constant_values=not beyond)
    outside = 0.0 if beyond else np.inf
    if free.all():
        return np.full(len(points_mm), outside)
    away = exact_distance(free)
    pixels = np.rint(np.nan_to_num(view.carm.project(points_mm)[0], nan=-9.0)).astype(np.int64) + 1
    column, row = pixels[:, 0], pixels[:, 1]
    rows, columns = free.shape
    seen = (row > 0) & (row < rows - 1) & (column > 0) & (column < columns - 1)
    found = away[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
    out: Array = np.where(seen, found * view.carm.pixel_at_isocenter_mm, outside)
    return out
