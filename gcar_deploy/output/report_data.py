"""What the drawings of report.html are made from: rounded, and thinned to what a screen shows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.measure.lumen import branch_lumen, reference_stretch
from gcar_deploy.output.overlay import branch_color
from gcar_deploy.output.result import Result
from gcar_deploy.tree.tree import Branch
from gcar_deploy.types import Array, Points, Scalars

#: numbers in the page, all branches together; a point has seven, and three more a view
_NUMBERS = 22_000
#: places in a picture are whole numbers of this share of its size
PLACES = 4096


def scene_data(result: Result, further: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return branches and directions as plain values.

    Parameters
    ----------
    further : ``best_further_view`` of the summary

    Returns
    -------
    ``branches``: per branch points (mm LPS), arc, radius, reference diameter's half (None near
    the ends), sigma, per view the place in the picture and the residual (mm, None outside),
    colour, least diameter and lesion; ``views``: directions of the views, then the best further
    one; ``longest``: the branch to begin with
    """
    points = len(result.tree.points())
    stride = max(1, -(-points * (7 + 3 * len(result.views)) // _NUMBERS))
    distances = [_distance_mm(view) for view in result.views]
    branches = []
    for number, branch in enumerate(result.tree.branches):
        keep = np.unique([*range(0, len(branch), stride), len(branch) - 1])
        branches.append(_branch(branch, number, keep, result, distances))
    carms = [view.carm for view in result.views]
    views = [[carm.primary_angle_deg, carm.secondary_angle_deg] for carm in carms]
    if further is not None:
        views.append([further["primary_angle_deg"], further["secondary_angle_deg"]])
    lengths = [branch.length_mm for branch in result.tree.branches]
    return {
        "branches": branches,
        "views": views,
        "places": PLACES,
        "longest": int(np.argmax(lengths)) if lengths else -1,
    }


def residuals(points_mm: Points, view: VesselImage, distance_mm: Array) -> Scalars:
    """(n,) distance of reprojected points from the view's vessels, mm; NaN outside the picture."""
    pixels, depth = view.carm.project(points_mm)
    column, row = np.rint(np.nan_to_num(pixels, posinf=-1, neginf=-1)).T
    rows, columns = distance_mm.shape
    inside = (depth > 1.0) & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    out: Scalars = np.full(len(points_mm), np.nan)
    out[inside] = distance_mm[row[inside].astype(int), column[inside].astype(int)]
    return out


def _distance_mm(view: VesselImage) -> Array:
    """(rows, cols) distance to the nearest pixel of the view's skeleton, mm at the isocentre."""
    if not view.skeleton.any():
        return np.full(view.skeleton.shape, np.nan)
    pixels = cv2.distanceTransform((~view.skeleton).astype(np.uint8), cv2.DIST_L2, 5)
    distance: Array = pixels * view.carm.pixel_at_isocenter_mm
    return distance


def _branch(
    branch: Branch, number: int, keep: Array, result: Result, distances: list[Array]
) -> dict[str, Any]:
    blue, green, red = branch_color(number)
    reference = np.full(len(branch), np.nan)
    at, healthy = reference_stretch(branch)
    reference[at] = healthy / 2
    lumen = branch_lumen(branch, number)
    points = branch.points_mm[keep]
    seen = []
    for view, distance in zip(result.views, distances, strict=True):
        pixels, depth = view.carm.project(points)
        # A pixel's middle is half a pixel from its corner, where a canvas begins to count.
        size = np.array([view.carm.columns, view.carm.rows])
        share = np.where(depth[:, None] > 1.0, (pixels + 0.5) / size, -1.0)
        place = np.clip(np.rint(share * PLACES), -PLACES, 2 * PLACES).astype(int)
        seen.append(
            {"at": place.tolist(), "residual": _known(residuals(points, view, distance), 2)}
        )
    return {
        "points": np.round(points, 2).tolist(),
        "arc": np.round(branch.arc_mm[keep], 2).tolist(),
        "radius": np.round(branch.radius_mm[keep], 2).tolist(),
        "reference": _known(reference[keep], 2),
        "sigma": _known(branch.sigma_mm[keep], 2),
        "seen": seen,
        "name": None if (name := result.names[number]) is None else name.name,
        "color": f"rgb({red},{green},{blue})",
        "least": None
        if lumen.minimal_at_mm is None
        else [round(lumen.minimal_at_mm, 2), round(lumen.minimal_diameter_mm or 0.0, 2)],
        "stenosis": _one(lumen.stenosis_percent),
        "lesion": _one(lumen.lesion_length_mm),
    }


def _known(values: Scalars, digits: int) -> list[float | None]:
    return [round(float(v), digits) if np.isfinite(v) else None for v in values]


def _one(value: float | None) -> float | None:
    return None if value is None else round(value, 1)
