"""Centres as the paper places them: what each view predicts, side by side, and nothing else.

Every cell that shows vessel is one centre on its true ray (``center_map.decode``). The centres of V
views together hold the vessel's volume once: each stands for the path that its cell shows, over
the cell's area at its depth, divided by V. No hull takes part, and no view corrects another; that
is left to the optimisation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.carm import CArm, separation_deg
from gcar_deploy.predict.center_map import ViewCenters, blocks

#: a view within this of a direction that the model was trained on counts as one of these, degrees
SAME_DIRECTION_DEG = 5.0


def placed_centers(views: Sequence[ViewCenters]) -> CenterPoints:
    """Put the centres of single views side by side.

    Parameters
    ----------
    views : ViewCenters, one or more, as ``SingleViewPredictor.predict`` returns them

    Returns
    -------
    CenterPoints, as many as there are cells with vessel in all views, no radius;
    ``source = "paper"``.
    """
    spacing = min(view.alpha * view.picture.pixel_mm for view in views)
    points = np.concatenate([view.points_mm for view in views])
    volume = np.concatenate([_volumes_mm3(view) for view in views]) / len(views)
    return CenterPoints(
        points_mm=points,
        confidence=volume / spacing**3,
        radius_mm=np.full(len(points), np.nan),
        spacing_mm=spacing,
        source="paper",
    )


def known_views(carms: Sequence[CArm], directions_deg: Sequence[Sequence[float]]) -> list[int]:
    """Which views a model was trained for.

    Parameters
    ----------
    carms : all views
    directions_deg : (primary, secondary) of those it was trained on; none: any

    Returns
    -------
    indices of views within ``SAME_DIRECTION_DEG`` of one of these, possibly none
    """
    return [
        k
        for k, carm in enumerate(carms)
        if not directions_deg
        or any(
            separation_deg(carm, _towards(carm, *direction)) <= SAME_DIRECTION_DEG
            for direction in directions_deg
        )
    ]


def _towards(carm: CArm, primary_deg: float, secondary_deg: float) -> CArm:
    there = (primary_deg - carm.primary_angle_deg, secondary_deg - carm.secondary_angle_deg)
    return carm.turned(*there)


def _volumes_mm3(view: ViewCenters) -> np.ndarray:
    """(n,) vessel volume that the cell of each centre shows, at the centre's depth."""
    picture = view.picture
    path = blocks(picture.path_mm, view.alpha).mean(axis=2)[tuple(view.cell.T)]
    magnified = view.ray_mm / np.linalg.norm(picture.carm.source_mm)
    volume: np.ndarray = path * (view.alpha * picture.pixel_mm * magnified) ** 2
    return volume
