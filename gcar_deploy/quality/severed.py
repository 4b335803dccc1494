"""A tree in pieces where a catheter or lead was left out: vessel may have gone with it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array

#: a free end so near to what was left out may have been cut by it, mm at the isocentre
NEAR_MM = 3.0


def check_severed(tree: Tree, views: Sequence[VesselImage]) -> list[str]:
    """Doubt a tree of several pieces of which one ends where a catheter or lead was left out.

    Where a line crosses vessels, the vessels are cut with it, and what is left of them can be
    joined wrongly. A catheter ends at the inlet of a tree in one piece, so that one is not asked.

    Parameters
    ----------
    tree : Tree
    views : the pictures that it was made from
    """
    pieces = len(np.unique(tree.components()))
    if pieces < 2:
        return []
    ends = tree.nodes_mm[tree.degrees == 1]
    for view in views:
        if view.catheter is not None and (_distance_mm(view, ends) < NEAR_MM).any():
            return [
                f"the tree falls into {pieces} pieces, and one ends where a catheter or lead was "
                f"left out of view {view.view_id}: vessel may be missing, or wrongly joined"
            ]
    return []


def _distance_mm(view: VesselImage, points_mm: Array) -> Array:
    """(n,) distance of points from what was left out of a view, mm at the isocentre."""
    left = np.asarray(view.catheter, bool)
    if not left.any():
        return np.full(len(points_mm), np.inf)
    away = cv2.distanceTransform((~left).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    pixels = np.rint(np.nan_to_num(view.carm.project(points_mm)[0], nan=-9.0)).astype(np.int64)
    inside = ((pixels >= 0) & (pixels < np.array(left.shape[::-1]))).all(axis=1)
    column, row = pixels[inside].T
    out = np.full(len(points_mm), np.inf)
    out[inside] = away[row, column] * view.carm.pixel_at_isocenter_mm
    return out
