"""Which further view would help most, computed from the tree that was found.

Every centreline point has a worst direction across the vessel; its Cramer-Rao bound
(``observability.curve_sigmas``) tells how badly the present views hold it. A further view adds
information along the direction that it measures. The view is advised that lowers the bound of the
badly held part of the tree most.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from gcar_deploy.geometry.carm import CArm, separation_deg
from gcar_deploy.geometry.observability import curve_sigmas
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Points

#: what a cardiac C-arm reaches, degrees, and the step of the search
PRIMARY_DEG = range(-90, 91, 10)
SECONDARY_DEG = range(-40, 41, 10)
#: a view nearer than this to a present one (or its opposite) adds little but its own errors
LEAST_APART_DEG = 20.0
#: the badly held part: this percentile of the bound
PERCENTILE = 90.0
#: points at most; a tree's bound varies slowly along it
_MOST_POINTS = 160
#: a bound beyond this says no more than that nothing holds the point, mm
_CAP_MM = 20.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Advice:
    """A further view, and what it would change.

    Attributes
    ----------
    primary_angle_deg, secondary_angle_deg : float
    name : str, clinical words
    sigma_now_mm, sigma_then_mm : float
        90th percentile over the tree of the bound across the vessel, from one pixel of noise.
    """

    primary_angle_deg: float
    secondary_angle_deg: float
    name: str
    sigma_now_mm: float
    sigma_then_mm: float

    @property
    def sentence(self) -> str:
        """The advice in words."""
        return (
            f"a further view at {self.name} would hold the worst tenth of this tree to "
            f"{self.sigma_then_mm:.2g} mm instead of {self.sigma_now_mm:.2g} mm "
            "(bound from one pixel of noise)"
        )


def advise(tree: Tree, carms: Sequence[CArm]) -> Advice | None:
    """Search the directions that a C-arm reaches; None without a tree or without any gain.

    Parameters
    ----------
    tree : Tree, mm LPS
    carms : the present views; the further one is like the first, turned
    """
    points, tangents = _sample(tree)
    if len(points) == 0:
        return None
    now = _worst(carms, points, tangents)
    best: Advice | None = None
    for a, b in itertools.product(PRIMARY_DEG, SECONDARY_DEG):
        further = dataclasses.replace(
            carms[0], primary_angle_deg=float(a), secondary_angle_deg=float(b),
            projection_matrix=None, isocenter_offset_mm=(0.0, 0.0, 0.0),
        )  # fmt: skip
        apart = (separation_deg(further, c) for c in carms)
        if min(min(s, 180.0 - s) for s in apart) < LEAST_APART_DEG:
            continue
        then = _worst([*carms, further], points, tangents)
        if best is None or then < best.sigma_then_mm:
            best = Advice(
                primary_angle_deg=float(a), secondary_angle_deg=float(b),
                name=further.clinical_name(), sigma_now_mm=now, sigma_then_mm=then,
            )  # fmt: skip
    return best if best is not None and best.sigma_then_mm < 0.95 * now else None


def _worst(carms: Sequence[CArm], points: Points, tangents: Points) -> float:
    sigma = np.minimum(curve_sigmas(carms, points, tangents), _CAP_MM)
    return float(np.percentile(sigma, PERCENTILE))


def _sample(tree: Tree) -> tuple[Array, Array]:
    if not tree.branches:
        return np.empty((0, 3)), np.empty((0, 3))
    points = np.concatenate([branch.points_mm for branch in tree.branches])
    tangents = np.concatenate([branch.tangents for branch in tree.branches])
    step = max(1, -(-len(points) // _MOST_POINTS))
    return points[::step], tangents[::step]
