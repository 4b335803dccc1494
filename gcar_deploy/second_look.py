"""A second look: the tree once more, of the same scene turned.

How a scene lies in its frame says nothing of its vessels, but cells fall on them otherwise, and the
predictor sees them in another light. What the pictures decide comes out as before; what comes out
elsewhere was chosen between trees that explain them as well.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.config import RunOptions
from gcar_deploy.errors import CancelledError, NumericalError, RefusedError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.predict import Predictor, find_centers, seen_by_all
from gcar_deploy.quality import GHOST_MM
from gcar_deploy.stopwatch import Stopwatch
from gcar_deploy.tree.curves import points_every
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes import refine
from gcar_deploy.types import Array, Points

#: the scene is turned about the axis from foot to head by these: hearts differ by as much, and no
#: cell is where one was, deg
TURNS_DEG = (17.0, -23.0)
#: what one turn moves by no more is not turned again, share of the tree
SURE = 0.02
#: trees are compared at points so far apart, mm
_STEP_MM = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class SecondLook:
    """What a tree was made with, to make it again.

    Attributes
    ----------
    views, grid, predictor, options : as the tree was made with
    watch : Stopwatch, whose budget ends the refinement
    """

    views: Sequence[VesselImage]
    grid: Grid
    predictor: Predictor | None
    options: RunOptions
    watch: Stopwatch

    def doubt(self, tree: Tree) -> str | None:
        """Return why a tree is doubted that lies ``elsewhere``, if it does; late is a reason, too.

        Raises
        ------
        CancelledError
            Cancelled.
        """
        most = self.options.quality.good_second_look
        try:
            share = self.elsewhere(tree)
        except (NumericalError, RefusedError) as error:
            # The tree that was asked about is there, and stays.
            return f"a second look came to nothing ({error}): branches may lie elsewhere"
        except CancelledError:
            if self.watch.cancelled:
                raise
            return "the deadline left no time for a second look: branches may lie elsewhere"
        if share <= most:
            return None
        return (
            f"made again of the same pictures with the scene turned, {share:.0%} of the tree lies "
            f"elsewhere (at most {most:.0%} is usual): they leave open which vessel is which; "
            "a third view would tell"
        )

    def elsewhere(self, tree: Tree) -> float:
        """Share of a tree that lies elsewhere once the scene is turned, the most of turns tried.

        Parameters
        ----------
        tree : Tree, mm LPS; its inlets do not matter

        Returns
        -------
        0 .. 1, the mean of both trees' shares that lie further than ``GHOST_MM`` from the other

        Raises
        ------
        CancelledError
            Cancelled or late.
        """
        own, most = points_every(tree, _STEP_MM), 0.0
        for deg in TURNS_DEG:
            most = max(most, _apart(own, points_every(self._turned(deg), _STEP_MM)))
            if not SURE < most <= self.options.quality.good_second_look:
                break
        return most

    def _turned(self, deg: float) -> Tree:
        """Make the tree of the scene turned by ``about_z``, and turn it back."""

        def turned(view: VesselImage) -> VesselImage:
            others = tuple(turned(other) for other in view.others)
            return dataclasses.replace(
                view, carm=carm_turned(view.carm, deg), others=others, kept=None
            )

        turn, options, predictor = about_z(deg), self.options, self.predictor
        there = [turned(view) for view in self.views]
        x, y, z = (turn @ np.asarray(self.grid.center_mm)).tolist()
        grid = dataclasses.replace(self.grid, center_mm=(x, y, z))
        seen = seen_by_all(there, grid, options, predictor)
        centers = find_centers(seen, predictor, options, self.watch)
        told = None if centers.evidence is None else centers.evidence.points
        budget = self.watch.budget()
        refined = refine(centers.points, there, options.refine, None, budget, told).or_fail()
        tree = refined.tree
        back = [dataclasses.replace(b, points_mm=b.points_mm @ turn) for b in tree.branches]
        here = dataclasses.replace(tree, nodes_mm=tree.nodes_mm @ turn, branches=tuple(back))
        kept, _ = refined.with_tree(here).without(options.deleted_mm)
        return kept.tree


def about_z(deg: float) -> Array:
    """(3, 3) turn about the axis from foot to head."""
    c, s = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def carm_turned(carm: CArm, deg: float) -> CArm:
    """Return the view that shows a scene turned by ``about_z`` as ``carm`` shows it now."""
    told = carm.turned(deg)
    x, y, z = (about_z(deg) @ told.isocenter_offset_mm).tolist()
    return dataclasses.replace(told, isocenter_offset_mm=(x, y, z))


def _apart(one: Points, other: Points) -> float:
    if not len(one) or not len(other):
        return 1.0
    far = [cKDTree(b).query(a)[0] > GHOST_MM for a, b in ((one, other), (other, one))]
    return 0.5 * float(far[0].mean() + far[1].mean())
