"""Ends of the tree that no picture shows as an end: vessels may be torn, and joined wrongly.

Where a vessel ends, so does a line of every view, unless another vessel hides it there. Few true
ends are hidden in all views. Where halves of two vessels were married, either goes on in every
picture past the end that the tree gives it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.quality.nearness import distance_mm
from gcar_deploy.tree.tree import Tree

#: an end is shown where a line of the picture ends so near to it, mm at the isocentre
NEAR_MM = 4.0
#: so many hidden ends, of branches with more than this share of the length of all that end
#: somewhere, are too many. Chosen on drawn shapes, grown pairs and generated left and right trees
#: (seeds 905, 77000 and 91000): of 163 that were ``ok`` five have more, among them both below F 0.6
LEAST_ENDS, MOST_SHARE = 2, 0.5


def check_hidden_ends(tree: Tree, views: Sequence[VesselImage]) -> list[str]:
    """Doubt a tree most of which ends where no picture shows an end.

    Parameters
    ----------
    tree : Tree
    views : the pictures that it was made from
    """
    ends = [node for branch in tree.branches for node in (branch.start, branch.end)]
    length = np.repeat([branch.length_mm for branch in tree.branches], 2)
    free = tree.degrees[ends] == 1
    points, length = tree.nodes_mm[ends][free], length[free]
    hidden = np.ones(len(points), bool)
    for view in views:
        last = view.skeleton & (skel.neighbours(view.skeleton) <= 1)
        hidden &= distance_mm(view, points, last, beyond=True) > NEAR_MM
    if hidden.sum() < LEAST_ENDS or length[hidden].sum() <= MOST_SHARE * length.sum():
        return []
    return [
        f"{hidden.sum()} of the tree's {len(hidden)} ends are seen as an end in no view: pieces of "
        "different vessels may be joined"
    ]
