"""Centres without a model: thin the hull until each pixel of each view is explained once.

The path length of a ray says how many full cells lie on it. Starting from the even share, the
occupancies are multiplied in turn by what each view still lacks (multiplicative algebraic
reconstruction, Gordon et al. 1970, held to 0 .. 1), smoothed over touching cells so that vessels
stay whole, and sharpened so that the many weak shares give way to few strong ones.
"""

from __future__ import annotations

import numpy as np

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.predict.encoding import Encoded
from gcar_deploy.predict.hull import Candidates
from gcar_deploy.types import Array, Scalars

#: passes over all views, and the power applied after each; above 1 weak shares give way to strong
STEPS, SHARPNESS = 40, 1.05


def thin_hull(candidates: Candidates, encoded: Encoded) -> CenterPoints:
    """Share the path of every ray among the hull points behind it.

    Returns
    -------
    CenterPoints with the occupancy as confidence and no radius; ``source = "hull"``.
    """
    x = np.full(len(candidates), 0.5)
    for iteration in range(STEPS):
        x = _explain(x, encoded)
        if iteration < STEPS - 3:
            x = _smooth(x, encoded.neighbours[0]) ** SHARPNESS
    return CenterPoints(
        points_mm=candidates.points_mm,
        confidence=x,
        radius_mm=np.full(len(x), np.nan),
        spacing_mm=candidates.spacing_mm,
        source="hull",
    )


def _explain(x: Scalars, encoded: Encoded) -> Scalars:
    """One multiplicative pass over all views."""
    for ray, path, weight in zip(encoded.ray, encoded.ray_path, encoded.weight, strict=True):
        made = np.bincount(ray, weights=x * weight, minlength=len(path))
        # The floor keeps an empty ray from being blown up; the ceiling one pass from overshooting.
        ratio = np.clip(path / np.maximum(made, 1e-3), 0.25, 4.0)
        x = np.clip(x * ratio[ray], 0.0, 1.0)
    return x


def _smooth(x: Scalars, neighbours: Array) -> Scalars:
    padded = np.append(x, 0.0)
    around = padded[neighbours].sum(axis=1) - x
    # Two full neighbours, as along a thin vessel, are support enough.
    return x * (0.5 + 0.5 * np.minimum(around / 2.0, 1.0))
