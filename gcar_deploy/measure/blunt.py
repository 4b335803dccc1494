"""Ostia that are no free end: where a side branch seems to go on from an artery's beginning.

A conus branch that lies on the beginning of its artery in a picture is built on to the very end of
it. Outward from the first fork the vessel is then as wide as ever, or wider, and of a sudden thin:
an artery tapers the other way (Murray, Proc Natl Acad Sci 12:207, 1926).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.measure.routes import END_MM
from gcar_deploy.tree.tree import Branch, Tree, polyline_arc
from gcar_deploy.types import Array, Scalars

#: the vessel's width behind the fork is read between these, mm from it
NEAR_MM = (3.0, 13.0)
#: it ends where it was last so wide, up to there it has not tapered, and what goes on is at most
#: so wide, as shares of that; over so much of its length, mm, it may narrow
WIDE, EVEN, THIN, STEP_MM = 0.8, 0.95, 0.65, 4.0
#: so long at least are the artery's beginning and what goes on from it, mm
LEAST_MM = (15.0, 5.0)


@dataclasses.dataclass(frozen=True)
class Blunt:
    """An artery's beginning that is no free end.

    Attributes
    ----------
    branch, point : where it lies, by the number of the branch and of its point
    radius_mm : of the vessel there, mean over ``routes.END_MM``
    """

    branch: int
    point: int
    radius_mm: float


def blunt_begins(tree: Tree) -> list[Blunt]:
    """Find where vessels end bluntly in a thin one, looking outward from forks."""
    found = (_blunt(*_outward(tree, node)) for node in np.flatnonzero(tree.degrees == 1).tolist())
    return [one for one in found if one is not None]


def _outward(tree: Tree, tip: int) -> tuple[Array, Scalars, Scalars, bool]:
    """Follow a free end to its fork.

    Returns
    -------
    (m, 2) branch and point of each place from the fork to the tip, (m,) radius and arc, mm, and
    whether there is a fork
    """
    at: list[tuple[int, int]] = []
    node, last = tip, -1
    while True:
        leaving = [k for k, b in enumerate(tree.branches) if node in (b.start, b.end) and k != last]
        if len(leaving) != 1:
            break
        last = leaving[0]
        own: Branch = tree.branches[last]
        points = range(len(own)) if own.start == node else range(len(own) - 1, -1, -1)
        at += [(last, point) for point in points]
        node = own.end if own.start == node else own.start
    at = at[::-1]
    points_mm = np.array([tree.branches[k].points_mm[i] for k, i in at])
    radius = np.array([tree.branches[k].radius_mm[i] for k, i in at])
    return np.array(at), radius, polyline_arc(points_mm), bool(tree.degrees[node] > 2)


def _blunt(at: Array, radius: Scalars, arc: Scalars, forked: bool) -> Blunt | None:
    near = (arc >= NEAR_MM[0]) & (arc <= NEAR_MM[1])
    if not forked or arc[-1] < sum(LEAST_MM) or not near.any():
        return None
    begin = float(radius[near].mean())
    end = int(np.flatnonzero(radius >= WIDE * begin)[-1])
    inside = (arc >= arc[end] - END_MM) & (arc <= arc[end])
    behind = arc > arc[end] + STEP_MM
    wide = float(radius[inside].mean())
    if (
        arc[end] < LEAST_MM[0]
        or arc[-1] - arc[end] < LEAST_MM[1]
        or wide < EVEN * begin
        or (radius[behind] > THIN * begin).any()
    ):
        return None
    return Blunt(int(at[end, 0]), int(at[end, 1]), wide)
