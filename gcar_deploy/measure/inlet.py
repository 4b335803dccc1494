"""Where the blood comes in: the inlet of each component, and the tree run from there.

The rule, for each component by itself (a left and a right tree each have their own):

1. the ostium of the left main or right coronary artery, where anatomy names one
   (``measure.naming``, with at least the probability that a name needs);
2. else the thickest free end, its radius averaged over the last ``routes.END_MM`` mm: coronary
   arteries taper from the ostium on (Murray, Proc Natl Acad Sci 12:207, 1926);
3. else, in a ring without a free end, the thickest node.

The second and third look at radii and lengths alone, so that a mirrored or turned tree keeps its
inlet.
"""

from __future__ import annotations

import numpy as np

from gcar_deploy.measure.naming import read_anatomy
from gcar_deploy.measure.routes import end_radii
from gcar_deploy.tree.rooted import rooted
from gcar_deploy.tree.tree import Tree

#: radii closer than this are equal, and the lower node number decides: rounding must not, mm
_SAME_MM = 1e-6


def from_inlets(tree: Tree) -> Tree:
    """Run every branch from its inlet to its end and number the branches from there.

    Parameters
    ----------
    tree : Tree, mm LPS; points and radii stay as they are

    Returns
    -------
    Tree, see ``tree.rooted``
    """
    return rooted(tree, inlets(tree))


def inlets(tree: Tree) -> tuple[int, ...]:
    """Node of the inlet of each component that has a branch, by the rule above."""
    named = set(read_anatomy(tree).inlets)
    free = end_radii(tree)
    thickest: dict[int, float] = {}
    for branch in tree.branches:
        for node, radius in (
            (branch.start, branch.radius_mm[0]),
            (branch.end, branch.radius_mm[-1]),
        ):
            thickest[node] = max(thickest.get(node, 0.0), float(radius))
    component = tree.components()
    out = []
    for k in np.unique([component[node] for node in thickest]).tolist():
        own = [node for node in sorted(thickest) if component[node] == k]
        ends = [node for node in own if node in named] or [node for node in own if node in free]
        radii = free if ends else thickest
        out.append(max(ends or own, key=lambda n: (round(radii[n] / _SAME_MM), -n)))
    return tuple(out)
