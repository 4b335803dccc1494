"""Lines that run out of a grey picture: catheters come from its border, vessels rarely."""

from __future__ import annotations

from collections.abc import Sequence

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.quality.nearness import distance_mm
from gcar_deploy.tree.tree import Tree

#: a free end so near to where the picture ends is cut by it, mm at the isocentre
BORDER_MM = 2.0
#: shorter branches are left alone, mm
LEAST_MM = 20.0


def check_border(tree: Tree, views: Sequence[VesselImage]) -> list[str]:
    """Doubt long branches that end where a grey picture ends.

    A catheter that the segmentation took for vessel is explained by the tree like any vessel, and
    all views agree on it; that it comes from the border tells it apart. Masks and calibrated
    pictures hold what their maker let in, so that only vessels can be cut there.

    Parameters
    ----------
    tree : Tree
    views : the pictures that it was made from
    """
    grey = [view for view in views if not view.calibrated and view.kind != "mask"]
    free = tree.degrees == 1
    cut = [
        free & (distance_mm(view, tree.nodes_mm, ~view.valid, beyond=True) < BORDER_MM)
        for view in grey
    ]
    for number, branch in enumerate(tree.branches, start=1):
        if branch.length_mm < LEAST_MM:
            continue
        for view, nodes in zip(grey, cut, strict=True):
            if nodes[[branch.start, branch.end]].any():
                return [
                    f"branch {number} runs out of view {view.view_id}: a catheter or lead, or a "
                    "vessel that is cut there?"
                ]
    return []
