"""What the drawings of report.html are made from: rounded, and thinned to what a screen shows."""

from __future__ import annotations

from typing import Any

import numpy as np

from gcar_deploy.output.colors import SCALE, UNKNOWN, branch_color, css
from gcar_deploy.reconstruction import Reconstruction
from gcar_deploy.tree.rooted import inlet_arcs
from gcar_deploy.types import Scalars

#: numbers in the page, all branches together; a point has eight, and three more a view
_NUMBERS = 22_000
#: places in a picture are whole numbers of this share of its size
PLACES = 4096


def scene_data(result: Reconstruction) -> dict[str, Any]:
    """Return branches and directions as plain values.

    Returns
    -------
    ``branches``: per branch its number, points (mm LPS), arc, radius, reference diameter's half
    (None near the ends), sigma, probability of a ghost, per view the place in the picture and the
    residual (mm, None outside), colour, distance from the ostium, gravest narrowing, lesion,
    further ones, and what it narrows to where that is none; ``views``: directions of the views,
    then the best further one; ``longest``: the branch to begin with; ``scale``: both ends of the
    colours of a measure, ``unknown``: the colour of what has none
    """
    points = len(result.tree.points())
    stride = max(1, -(-points * (8 + 3 * len(result.views)) // _NUMBERS))
    lengths = [branch.length_mm for branch in result.tree.branches]
    carms = [view.carm for view in result.views]
    views = [[carm.primary_angle_deg, carm.secondary_angle_deg] for carm in carms]
    further = result.measured.further
    if further is not None:
        views.append([further.primary_angle_deg, further.secondary_angle_deg])
    return {
        "branches": [
            {**_branch(result, k, stride), "from_ostium": None if far is None else round(far, 2)}
            for k, far in enumerate(inlet_arcs(result.tree))
        ],
        "views": views,
        "places": PLACES,
        "scale": SCALE,
        "unknown": css(UNKNOWN),
        "longest": int(np.argmax(lengths)) + 1 if lengths else 0,
    }


def _branch(result: Reconstruction, k: int, stride: int) -> dict[str, Any]:
    branch, lumen, name = result.tree.branches[k], result.measured.lumens[k], result.names[k]
    keep = np.unique([*range(0, len(branch), stride), len(branch) - 1])
    first = sum(len(other) for other in result.tree.branches[:k])
    points = branch.points_mm[keep]
    seen = []
    for view, gaps in zip(result.views, result.measured.residual_mm[:, first + keep], strict=True):
        pixels, depth = view.carm.project(points)
        # A pixel's middle is half a pixel from its corner, where a canvas begins to count.
        size = np.array([view.carm.columns, view.carm.rows])
        share = np.where(depth[:, None] > 1.0, (pixels + 0.5) / size, -1.0)
        place = np.clip(np.rint(share * PLACES), -PLACES, 2 * PLACES).astype(int)
        seen.append({"at": place.tolist(), "residual": _known(gaps, 2)})
    return {
        "branch": k + 1,
        "points": np.round(points, 2).tolist(),
        "arc": np.round(branch.arc_mm[keep], 2).tolist(),
        "radius": np.round(branch.radius_mm[keep], 2).tolist(),
        "reference": _known(lumen.healthy_mm[keep] / 2, 2),
        "sigma": _known(branch.sigma_mm[keep], 2),
        "ghost": _known(result.ghost_probability[k][keep], 2),
        "seen": seen,
        "name": None if name is None else name.name,
        "color": css(branch_color(k)[::-1]),
        "least": None
        if lumen.minimal_at_mm is None
        else [round(lumen.minimal_at_mm, 2), round(lumen.minimal_diameter_mm or 0.0, 2)],
        "stenosis": _one(lumen.stenosis_percent),
        "lesion": None if lumen.lesion_mm is None else np.round(lumen.lesion_mm, 1).tolist(),
        "further": [np.round(one.lesion_mm, 1).tolist() for one in (lumen.lesions or ())[1:]],
        "narrows": _one(lumen.narrows_to_mm),
    }


def _known(values: Scalars, digits: int) -> list[float | None]:
    return [round(float(v), digits) if np.isfinite(v) else None for v in values]


def _one(value: float | None) -> float | None:
    return None if value is None else round(value, 1)
