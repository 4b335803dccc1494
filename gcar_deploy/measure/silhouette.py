"""What an outline hides of a narrow place: a slanted vessel's shoulders cover the neck between.

A round section of radius R, a distance d along a vessel that a ray meets at the angle a, covers
in the outline, at the ray's own section, half a width of

    R sqrt(1 - (d tan(a) / R)^2):

seen from the side nothing but its own, seen along the vessel that of the widest near by. So a
width that another view's narrower profile explains this way says no more than that the vessel is
no wider.
"""

from __future__ import annotations

import numpy as np

from gcar_deploy.types import Array, Scalars

#: a width is explained up to so many standard deviations of both
SIGMAS = 2.0


def covered(arc_mm: Scalars, radius_mm: Array, sd: Array, sine: Array) -> Array:
    """Tell which widths of outlines may be those of what lies beside them along the vessel.

    Parameters
    ----------
    arc_mm : (m,) places along one branch
    radius_mm : (views, m) half of the width that each view's outline shows
    sd : (views, m) standard deviation of its logarithm
    sine : (views, m) of the angle between ray and vessel

    Returns
    -------
    (views, m) bool
    """
    out = np.zeros(radius_mm.shape, bool)
    # A shoulder may begin anywhere between two places.
    step = float(np.max(np.diff(arc_mm), initial=0.0))
    gap = np.maximum(np.abs(arc_mm[:, None] - arc_mm) - step, 0.0)
    tangent = sine / np.sqrt(np.maximum(1 - sine**2, 1e-12))
    for k, (own, slant) in enumerate(zip(radius_mm, tangent, strict=True)):
        for j, other in enumerate(radius_mm):
            if j == k:
                continue
            reach = 1 - (gap * slant[:, None] / other) ** 2
            widest = (other * np.sqrt(np.maximum(reach, 0.0))).max(axis=1)
            room = np.exp(SIGMAS * np.hypot(sd[j], sd[k]))
            out[k] |= (own > other * room) & (own < widest * room) & (sine[k] < sine[j])
    return out
