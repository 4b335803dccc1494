"""What several questions about a finished tree need of it, worked out once."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.predict import Evidence
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes import Footprint, footprint, tubes_of
from gcar_deploy.types import Array, Scalars

#: evidence further than so many cells from the surface of the tree is off it
CELLS_OFF = 2.0
#: and nearer than so many is on it
CELLS_ON = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class Shown:
    """A tree with what it was made from.

    Attributes
    ----------
    tree : Tree, mm LPS
    views : the pictures, with the geometry that it was made with
    evidence : what the predictor of all views said of n points, or None
    """

    tree: Tree
    views: Sequence[VesselImage]
    evidence: Evidence | None

    @functools.cached_property
    def prints(self) -> tuple[Footprint, ...]:
        """Where the tubes fall in each view."""
        tubes = tubes_of(self.tree)
        return tuple(footprint(tubes, view.carm, 1.0) for view in self.views)

    @functools.cached_property
    def gap(self) -> tuple[Scalars, Array]:
        """(n,) mm from each point of the evidence to the tree's surface, and nearest tree point.

        What lies far off is found at infinity, with a number beyond the last point.
        """
        if self.evidence is None:
            return np.zeros(0), np.zeros(0, np.int64)
        told = self.evidence.points
        radii = np.append(self.tree.radii(), 0.0)
        reach = float(radii.max()) + (CELLS_OFF + 1.0) * told.spacing_mm
        distance, nearest = cKDTree(self.tree.points()).query(
            told.points_mm, distance_upper_bound=reach
        )
        return distance - radii[nearest], nearest
