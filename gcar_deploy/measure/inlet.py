"""Where the blood comes in: the inlet of each component, and the tree run from there.

The rule, for each component by itself (a left and a right tree each have their own):

0. the free end nearest to an ostium that a person marked, where one lies within ``MARKED_MM``;
1. where a vessel ends bluntly in a thin one (``measure.blunt``), ``BLUNTLY`` as wide as any free
   end: a conus branch that seems to go on from the artery's beginning;
2. the ostium of the left main or right coronary artery, where anatomy names one
   (``measure.naming``, with at least the probability that a name needs);
3. else the thickest free end, its radius averaged over the last ``routes.END_MM`` mm: coronary
   arteries taper from the ostium on (Murray, Proc Natl Acad Sci 12:207, 1926);
4. else, in a ring without a free end, the thickest node.

The last two look at radii and lengths alone, so that a mirrored or turned tree keeps its
inlet.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from gcar_deploy.measure.blunt import blunt_begins
from gcar_deploy.measure.naming import read_anatomy
from gcar_deploy.measure.routes import end_radii
from gcar_deploy.tree.edit import parted
from gcar_deploy.tree.rooted import rooted
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Points

#: radii closer than this are equal, and the lower node number decides: rounding must not, mm
_SAME_MM = 1e-6
#: a marked ostium and the end of its artery may be so far apart: pictures seldom show the very
#: mouth, and a click is off by a pixel or two
MARKED_MM = 15.0
#: a beginning that is no free end is so many times as thick as every free end
BLUNTLY = 1.15
#: arteries taper: a free end so many times as thick as a marked ostium is worth a word
THICKER = 1.5


def from_inlets(tree: Tree, marked_mm: Points | None = None) -> Tree:
    """Run every branch from its inlet to its end and number the branches from there.

    Parameters
    ----------
    tree : Tree, mm LPS; points and radii stay as they are
    marked_mm : (m, 3) ostia that a person marked

    Returns
    -------
    Tree, see ``tree.rooted``; with a node at an inlet within a branch
    """
    tree, blunt = _parted_at_blunt(tree)
    return rooted(tree, inlets(tree, marked_mm, blunt))


def _parted_at_blunt(tree: Tree) -> tuple[Tree, set[int]]:
    """Return the tree with a node at every blunt beginning that may be an inlet, and those."""
    nodes: set[int] = set()
    free, component = end_radii(tree), tree.components()
    for one in blunt_begins(tree):
        own = component[tree.branches[one.branch].start]
        if one.radius_mm > BLUNTLY * max(r for n, r in free.items() if component[n] == own):
            tree, node = parted(tree, one.branch, one.point)
            nodes.add(node)
    return tree, nodes


def inlets(
    tree: Tree, marked_mm: Points | None = None, blunt: Collection[int] = ()
) -> tuple[int, ...]:
    """Node of the inlet of each component that has a branch, by the rule above.

    ``blunt``: nodes where a vessel begins bluntly.
    """
    named = set(read_anatomy(tree).inlets)
    thickest: dict[int, float] = {}
    for branch in tree.branches:
        for node, radius in (
            (branch.start, branch.radius_mm[0]),
            (branch.end, branch.radius_mm[-1]),
        ):
            thickest[node] = max(thickest.get(node, 0.0), float(radius))
    free = {**end_radii(tree), **{begin: thickest[begin] for begin in blunt}}
    marked = {end for place in (() if marked_mm is None else marked_mm)
              if (end := _end_at(tree, free, place)) is not None}  # fmt: skip
    component = tree.components()
    out = []
    for k in np.unique([component[node] for node in thickest]).tolist():
        own = [node for node in sorted(thickest) if component[node] == k]
        known = ([n for n in own if n in wanted] for wanted in (marked, blunt, named, free))
        ends = next((found for found in known if found), [])
        radii = free if ends else thickest
        out.append(max(ends or own, key=lambda n: (round(radii[n] / _SAME_MM), -n)))
    return tuple(out)


def idle_ostia(tree: Tree, marked_mm: Points) -> list[str]:
    """Return a sentence (a finding) for each marked ostium near which no vessel ends."""
    free = end_radii(tree)
    return [
        f"ostium {number}: no vessel ends within {MARKED_MM:g} mm of it"
        for number, place in enumerate(marked_mm, start=1)
        if _end_at(tree, free, place) is None
    ]


def thin_ostia(tree: Tree, marked_mm: Points) -> list[str]:
    """Return a sentence (a note) for each marked ostium whose artery has a much thicker end."""
    free, component, out = end_radii(tree), tree.components(), []
    for number, place in enumerate(marked_mm, start=1):
        node = _end_at(tree, free, place)
        if node is None:
            continue
        most = max(r for n, r in free.items() if component[n] == component[node])
        if most > THICKER * free[node]:
            out.append(
                f"ostium {number}: the vessel is {2 * free[node]:.1f} mm wide there, and "
                f"{2 * most:.1f} mm at another free end: was the far end marked?"
            )
    return out


def _end_at(tree: Tree, free: Mapping[int, float], place_mm: Points) -> int | None:
    """Free end nearest to a place, None where none lies within ``MARKED_MM``."""
    nodes = sorted(free)
    gaps = [float(np.linalg.norm(tree.nodes_mm[node] - place_mm)) for node in nodes]
    return nodes[int(np.argmin(gaps))] if nodes and min(gaps) <= MARKED_MM else None
