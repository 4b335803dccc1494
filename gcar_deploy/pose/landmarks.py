"""Landmarks: points that a person marked in several views, checked before they are used."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gcar_deploy.config import Landmark
from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import triangulate
from gcar_deploy.types import Array, Points


def landmark_pixels(landmarks: Sequence[Landmark], carms: Sequence[CArm]) -> Array:
    """Collect the landmarks as an array.

    Parameters
    ----------
    landmarks : each with one (col, row) or None per view
    carms : V views

    Returns
    -------
    (m, V, 2) float64, nan where a view does not show it

    Raises
    ------
    UsageError
        A landmark has not one entry per view, lies outside its picture, or is marked only once.
    """
    out = np.full((len(landmarks), len(carms), 2), np.nan)
    for m, landmark in enumerate(landmarks):
        if len(landmark) != len(carms):
            raise UsageError(
                f"landmark {m + 1} has {len(landmark)} points for {len(carms)} views; "
                "give one for each, - where it is not seen"
            )
        for k, (point, carm) in enumerate(zip(landmark, carms, strict=True)):
            if point is None:
                continue
            if not carm.shows(np.array([point])).all():
                raise UsageError(
                    f"landmark {m + 1}: ({point[0]:g}, {point[1]:g}) is outside the "
                    f"{carm.columns} x {carm.rows} pixels (columns x rows) of view {k + 1}"
                )
            out[m, k] = point
        if np.isfinite(out[m, :, 0]).sum() < 2:
            raise UsageError(f"landmark {m + 1} is marked in one view; two or more are needed")
    return out


def marked_places(marks: Sequence[Landmark], carms: Sequence[CArm]) -> Points:
    """(m, 3) places in space of points that were marked, mm: nearest to their rays.

    Parameters
    ----------
    marks : as ``landmark_pixels``
    carms : V views, corrections built in
    """
    out = []
    for pixels in landmark_pixels(marks, carms):
        seen = [k for k in range(len(carms)) if np.isfinite(pixels[k, 0])]
        out.append(triangulate([carms[k] for k in seen], [pixels[k][None] for k in seen])[0][0])
    return np.array(out).reshape(-1, 3)
