"""What a person says belongs together: this vessel in one view is that vessel in the other.

A stretch of vessel, between the places where lines meet or cross in a picture, can only stand
where each view that was marked shows its stretch: candidates that lie on the stretch of one view
and beside that of another are dropped, and with them every ghost of the stretch.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.config import Landmark
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.predict.hull import Candidates
from gcar_deploy.types import Array, Mask

#: a mark this near to a vessel's line means it, mm at the isocentre
NEAR_MM = 4.0
#: a stretch reaches beyond the drawn vessel by so many pixels: masks and poses are off by that
ROOM_PX = 2


def without_ghosts(
    hull: Candidates, views: Sequence[VesselImage], marks: Sequence[Landmark]
) -> Candidates:
    """Drop the candidates that contradict the marks.

    Parameters
    ----------
    hull : Candidates
    views : V vessel images with the geometry that is used
    marks : each with one (column, row) or None per view; a mark on no vessel says nothing
    """
    keep = np.ones(len(hull), bool)
    for mark in marks:
        on, wide = [], []
        for view, point in zip(views, mark, strict=True):
            stretch = None if point is None else stretch_at(view, point)
            if stretch is None:
                continue
            on.append(_shown(hull, view, stretch))
            wide.append(_shown(hull, view, _widened(stretch)))
        if len(on) > 1:
            keep &= ~np.any(on, axis=0) | np.all(wide, axis=0)
    return dataclasses.replace(hull, index=hull.index[keep], points_mm=hull.points_mm[keep])


def stretch_at(view: VesselImage, point: tuple[float, float]) -> Mask | None:
    """(rows, cols) bool, the vessel at a point as far as its line meets no other.

    Returns
    -------
    None where no vessel lies within ``NEAR_MM``
    """
    line = view.skeleton
    around = cv2.filter2D(line.astype(np.uint8), cv2.CV_8U, np.ones((3, 3), np.uint8)) - 1
    forks = cv2.dilate((line & (around > 2)).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    _, label = cv2.connectedComponents((line & ~forks).astype(np.uint8), connectivity=8)
    rows, columns = np.nonzero(label)
    if not len(rows):
        return None
    gap = np.hypot(columns - point[0], rows - point[1])
    nearest = int(gap.argmin())
    if gap[nearest] * view.carm.pixel_at_isocenter_mm > NEAR_MM:
        return None
    wanted = label[rows[nearest], columns[nearest]]
    # Each pixel of vessel belongs to the line that it is nearest to, forks and all.
    lines = np.argwhere(line)
    inside = np.argwhere(view.path_mm > 0)
    owner = cKDTree(lines).query(inside)[1]
    own = label[tuple(lines[owner].T)] == wanted
    out = np.zeros(line.shape, bool)
    out[tuple(inside[own].T)] = True
    return out


def _widened(stretch: Mask) -> Mask:
    size = 2 * ROOM_PX + 1
    wide: Mask = cv2.dilate(stretch.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    return wide


def _shown(hull: Candidates, view: VesselImage, mask: Mask) -> Array:
    """(n,) bool, whether a view shows each candidate within a mask."""
    pixels, _ = view.carm.project(hull.points_mm)
    at = np.rint(pixels).astype(int)[:, ::-1]
    inside = ((at >= 0) & (at < mask.shape)).all(axis=1)
    out = np.zeros(len(hull), bool)
    out[inside] = mask[tuple(at[inside].T)]
    return out
