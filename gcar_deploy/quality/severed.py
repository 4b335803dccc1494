"""A tree in pieces where a catheter or lead was left out: vessel may have gone with it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.quality.nearness import distance_mm
from gcar_deploy.tree.tree import Tree

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
        left = view.catheter
        if left is not None and (distance_mm(view, ends, left, beyond=False) < NEAR_MM).any():
            return [
                f"the tree falls into {pieces} pieces, and one ends where what looks like a "
                f"catheter or lead was left out of view {view.view_id}: vessel may be missing, or "
                "wrongly joined"
            ]
    return []
