"""Which view to take next: the direction that would lower the centreline's uncertainty most."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.observability import curve_information, information_from, worst_across
from gcar_deploy.measure.lumen import hidden_share
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array

#: directions that are looked at, degrees; not both angles large at once: within the ellipse
PRIMARY_DEG = tuple(range(-60, 61, 10))
SECONDARY_DEG = tuple(range(-40, 41, 10))
ELLIPSE_DEG = (65.0, 45.0)
#: points of the tree that are looked at
MOST_POINTS = 150
#: an unbounded uncertainty counts as this, mm
WORST_MM = 5.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class FurtherView:
    """A direction worth taking.

    Attributes
    ----------
    primary_angle_deg, secondary_angle_deg : float
    name : clinical words, for instance ``'LAO 10 CRA 40'``
    sigma_before_mm, sigma_after_mm : mean bound across the vessel for 1 px of noise, without and
        with that view
    foreshortening : share of the tree's length that it hides
    """

    primary_angle_deg: float
    secondary_angle_deg: float
    name: str
    sigma_before_mm: float
    sigma_after_mm: float
    foreshortening: float


def best_further_view(tree: Tree, carms: Sequence[CArm]) -> FurtherView | None:
    """Search the directions a C-arm reaches, in steps of 10 degrees.

    The measure is the mean Cramer-Rao bound across the vessel (``observability.worst_across``),
    which counts what is foreshortened by itself; None for a tree without a branch.
    """
    if not tree.branches:
        return None
    points = tree.points()
    tangents = np.concatenate([branch.tangents for branch in tree.branches])
    keep = np.unique(np.linspace(0, len(points) - 1, MOST_POINTS).astype(int))
    points, tangents = points[keep], tangents[keep]
    model = carms[0]

    known = sum(curve_information(carm, points, tangents) for carm in carms)

    def mean_sigma(information: Array) -> Array:
        found: Array = np.minimum(worst_across(information), WORST_MM).mean(axis=-1)
        return found

    looks = [
        CArm(
            primary_angle_deg=primary,
            secondary_angle_deg=secondary,
            sod_mm=model.sod_mm,
            sdd_mm=model.sdd_mm,
            rows=model.rows,
            columns=model.columns,
            pixel_spacing_mm=model.pixel_spacing_mm,
        )
        for primary, secondary in itertools.product(PRIMARY_DEG, SECONDARY_DEG)
        if np.hypot(primary / ELLIPSE_DEG[0], secondary / ELLIPSE_DEG[1]) <= 1
    ]
    sources = np.stack([carm.source_mm for carm in looks])
    focal_px = float(np.sqrt(np.prod(looks[0].focal_px)))
    sigma = mean_sigma(known + information_from(sources, focal_px, points, tangents))
    k = int(np.argmin(sigma))
    best = looks[k]
    return FurtherView(
        primary_angle_deg=best.primary_angle_deg,
        secondary_angle_deg=best.secondary_angle_deg,
        name=best.clinical_name(),
        sigma_before_mm=float(mean_sigma(np.asarray(known))),
        sigma_after_mm=float(sigma[k]),
        foreshortening=hidden_share(tree, best) or 0.0,
    )
