"""Lines of a picture that no branch explains: vessels may be missing from the tree."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Mask

#: a line is explained where a branch passes so near to it, or within the branch's radius, mm at the
#: isocentre
NEAR_MM = 1.5
#: so long a line, and so large a share of all that the view shows, is a vessel of its own. Of some
#: hundred ``ok`` pairs (seeds 905, 51973, 77000, 91000) two have one, one of them the worst
LEAST_MM, LEAST_SHARE = 20.0, 0.1
#: where every line is a vessel, as in masks and true paths, so much in pieces of so many mm each is
#: worth a word. Of some 60 ``ok`` pairs, real and generated ones (seeds 712002, 777002, 818102),
#: none has more than 3 %
PIECE_MM, LEAST_TOTAL = 3.0, 0.05


def check_missing(tree: Tree, views: Sequence[VesselImage]) -> list[str]:
    """Doubt a tree that leaves a long line of a picture unexplained, or many short ones.

    Faint vessels count for little in a view's coverage, so that a whole one may be missing.

    Parameters
    ----------
    tree : Tree
    views : the pictures that it was made from
    """
    said = []
    for view in views:
        pieces, whole = _missing_mm(tree, view)
        longest = max(pieces, default=0.0)
        total = sum(length for length in pieces if length >= PIECE_MM)
        certain = view.calibrated or view.kind == "mask"
        if longest >= max(LEAST_MM, LEAST_SHARE * whole):
            said.append(
                f"view {view.view_id}: a line of {longest:.0f} mm is explained by no branch: a "
                "vessel that the other views hide or do not show?"
            )
        elif certain and total >= max(LEAST_MM, LEAST_TOTAL * whole):
            said.append(
                f"view {view.view_id}: {total:.0f} mm of its lines ({total / whole:.0%}) are "
                "explained by no branch: thin vessels that were not found?"
            )
    return said


def _missing_mm(tree: Tree, view: VesselImage) -> tuple[list[float], float]:
    """Lengths of the lines that no branch passes, and of all lines, mm."""
    line = np.argwhere(view.skeleton)
    if not len(line) or not tree.branches:
        return [], 0.0
    mm = view.carm.pixel_at_isocenter_mm
    passes = cKDTree(view.carm.project(tree.points())[0] * mm)
    gap, nearest = passes.query(line[:, ::-1] * mm)
    far = gap > np.maximum(NEAR_MM, tree.radii()[nearest])
    missing: Mask = np.zeros(view.skeleton.shape, bool)
    missing[tuple(line[far].T)] = True
    sizes = cv2.connectedComponentsWithStats(missing.astype(np.uint8), connectivity=8)[2]
    return (mm * sizes[1:, cv2.CC_STAT_AREA]).tolist(), mm * len(line)
