"""A tree of ways through the pairs of two views' lines, which together explain both pictures.

Way after way, each the one that explains most line for what it costs: from the tree to the ends of
lines, by steps whose length counts the more, the less the predictor believes in their places and
the worse the widths of both lines agree. A way is looked for in both pictures at once, so that it
can be told from a ghost over its whole course, not place by place.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.tree.curves import draw_branches
from gcar_deploy.tree.tree import Tree, empty_tree
from gcar_deploy.tubes.line_pairs import LinePairs
from gcar_deploy.types import Array, Scalars

#: a step costs this more, mm, than it is long, so that ways do not dither
STEP_COST_MM = 0.05
#: a way may cost so many mm for each mm of line that it alone explains, of so many mm at least
MOST_COST, LEAST_GAIN_MM = 8.0, 4.0
#: what an end costs in a view whose line goes on there, and a way that hangs on no other, mm
OPEN_END_MM, ROOT_MM = 6.0, 50.0
#: an end this near to that of a line is none that is open, mm
AT_TIP_MM = 1.6
#: widths that differ by more than this log ratio are those of lines that run over each other
MOST_MISFIT = 1.5
#: edges of what a tree's points stand for, mm; confidence that no tube starts below
CELL_MM, LEAST_CONFIDENCE = 1.0, 0.3
#: radii that tubes start with, mm
RADIUS_BOUNDS_MM = (0.3, 3.5)


@dataclasses.dataclass(frozen=True)
class Trust:
    """How much a mm of way costs more where nobody believes in it, and where widths differ."""

    doubt: float
    misfit: float


def tree_of_ways(pairs: LinePairs, told: Scalars, trust: Trust) -> Tree:
    """Find the ways that explain the lines of both views, as a tree.

    Parameters
    ----------
    pairs : LinePairs
    told : (n,) 0 .. 1, what the predictor said of each pair's point
    trust : Trust

    Returns
    -------
    Tree, maybe of several parts; empty where no way is worth its cost
    """
    ways = _Search(pairs, told, trust).ways()
    if not ways:
        return empty_tree()
    on = np.unique(np.concatenate(ways))
    points = CenterPoints(
        points_mm=pairs.points_mm[on],
        confidence=np.maximum(told[on] ** 2, LEAST_CONFIDENCE),
        radius_mm=np.clip(pairs.radius_mm[on], *RADIUS_BOUNDS_MM),
        spacing_mm=CELL_MM,
        source="lines",
    )
    return draw_branches(pairs.points_mm, ways, points)


class _Search:
    """Pairs as a graph with two more nodes: one before every root, one before the tree so far."""

    def __init__(self, pairs: LinePairs, told: Scalars, trust: Trust) -> None:
        self.pairs = pairs
        count = len(pairs)
        price = 1 + trust.doubt * (1 - told)
        price = price + trust.misfit * np.minimum(pairs.misfit, MOST_MISFIT)
        cost = (pairs.step_mm + STEP_COST_MM) * 0.5 * price[pairs.steps].sum(axis=1)
        one, other = pairs.steps.T
        self._rows, self._columns = np.concatenate([[one, other], [other, one]], axis=1)
        self._cost = np.tile(cost, 2)
        self._end_mm = np.zeros(count)
        self._left = [places.length_mm.copy() for places in pairs.places]
        for places, at in zip(pairs.places, pairs.at, strict=True):
            self._end_mm += OPEN_END_MM * np.clip(places.tip_mm[at] / AT_TIP_MM, 0.0, 1.0)

    def ways(self) -> list[Array]:
        """Pairs of each way, its end first; a later one ends on an earlier, or begins a part."""
        found: list[Array] = []
        on = np.zeros(len(self.pairs), bool)
        while True:
            way = self._next(on)
            if way is None:
                return found
            if len(way) > 1:
                found.append(way)
            on[way] = True
            for left, at in zip(self._left, self.pairs.at, strict=True):
                left[at[way]] = 0.0

    def _next(self, on: Array) -> Array | None:
        """Return the way that explains most for its cost; None where none is worth it."""
        count = len(on)
        here = [left[at] for left, at in zip(self._left, self.pairs.at, strict=True)]
        roots = np.flatnonzero((self._end_mm < OPEN_END_MM) & (here[0] > 0) & (here[1] > 0))
        tree = np.flatnonzero(on)
        graph = sparse.csr_matrix(
            (
                np.concatenate(
                    [self._cost, ROOT_MM + self._end_mm[roots], np.full(len(tree), 1e-9)]
                ),
                (
                    np.concatenate(
                        [self._rows, np.full(len(roots), count), np.full(len(tree), count + 1)]
                    ),
                    np.concatenate([self._columns, roots, tree]),
                ),
            ),
            shape=(count + 2, count + 2),
        )
        cost, before, _ = csgraph.dijkstra(
            graph, indices=[count, count + 1], min_only=True, return_predecessors=True
        )
        total = cost[:count] + self._end_mm
        gain = self._gains(before[:count], here)
        asked = np.flatnonzero(
            np.isfinite(total) & (gain > LEAST_GAIN_MM) & ((here[0] > 0) | (here[1] > 0))
        )
        if not len(asked):
            return None
        best = int(asked[(total[asked] / gain[asked]).argmin()])
        if total[best] > MOST_COST * gain[best]:
            return None
        way = [best]
        while not on[way[-1]] and before[way[-1]] < count:
            way.append(int(before[way[-1]]))
        return np.array(way)

    def _gains(self, before: Array, here: list[Scalars]) -> Scalars:
        """(n,) mm of line in both views that the way to each pair is the first to explain."""
        count = len(before)
        start = (before < 0) | (before >= count)
        last = np.where(start, np.arange(count), before)
        gain = np.zeros(count)
        for at, left in zip(self.pairs.at, here, strict=True):
            gain += np.where(start | (at != at[last]), left, 0.0)
        # Sums along all ways at once: each round doubles how far back they reach.
        while not (last == last[last]).all():
            gain = gain + np.where(last == np.arange(count), 0.0, gain[last])
            last = last[last]
        return gain + np.where(last == np.arange(count), 0.0, gain[last])
