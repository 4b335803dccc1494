"""CenterPoints: where a predictor (or the visual hull) believes vessel to be."""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.types import Points, Scalars


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class CenterPoints:
    """Candidate Gaussian centres.

    Attributes
    ----------
    points_mm : (n, 3) mm LPS
    confidence : (n,) 0 .. 1, share of the cell round the point believed to be vessel; a score
        that ranks points, not a calibrated probability
    radius_mm : (n,) expected vessel radius at the point, mm; NaN where unknown
    spacing_mm : float
        Edge of the lattice cells the points stand for, mm: ``confidence * spacing_mm**3``
        sums to the vessel's volume. A centre of a single view stands for all that its cell shows,
        which may be more than a cell holds.
    source : str
        ``"multi"``, ``"hull"``, or ``"paper"`` for centres of single views, each on its own.
    offset_mm : (n, 3) or None
        From the point to the nearest point of the centreline, mm, where the predictor says so.
    """

    points_mm: Points
    confidence: Scalars
    radius_mm: Scalars
    spacing_mm: float
    source: str
    offset_mm: Points | None = None

    def __len__(self) -> int:
        return len(self.points_mm)

    def select(self, keep: np.ndarray) -> CenterPoints:
        """Return the points at a boolean mask or index array."""
        return dataclasses.replace(
            self,
            points_mm=self.points_mm[keep],
            confidence=self.confidence[keep],
            radius_mm=self.radius_mm[keep],
            offset_mm=None if self.offset_mm is None else self.offset_mm[keep],
        )
