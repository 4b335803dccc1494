"""Gaps in which the points show nothing and every picture shows vessel.

In a tight stenosis few points are vessel and fewer are sure of it, and the tree made of them is
broken there. Each half would then be fitted for itself: its radius ends at the lesion, or both grow
over it beside each other. Where the vessel that was found in every picture goes on from one end to
the other, it is one tube from the start. Where it is broken in some picture, the gap stays one.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.distance import exact_distance
from gcar_deploy.tree.edit import UNTOLD
from gcar_deploy.tree.facing import LEAST_PART_MM, FreeEnd, joined_ends
from gcar_deploy.tree.tree import Branch, Tree
from gcar_deploy.types import Image, Points

#: longest gap, mm: in a longer one the curve from end to end is a guess
MOST_GAP_MM = 10.0
#: the vessel in a picture may be so far beside the curve from end to end, mm at its depth
OFF_MM = 1.5
#: a lumen thinner than a pixel comes and goes: a shorter break of a picture's vessel is none, mm
BREAK_MM = 2.0
#: a fitted branch is long enough to point somewhere, mm
LEAST_FITTED_MM = 2.0


def joined_in_pictures(tree: Tree, views: Sequence[VesselImage], *, fitted: bool = False) -> Tree:
    """Join ends that face each other where every view shows vessel all the way between.

    Parameters
    ----------
    tree : Tree, mm
    views : sequence of VesselImage
    fitted : of points, short branches point anywhere; a fitted one may lie between a fork and a
        lesion behind it

    Returns
    -------
    Tree, the same one where nothing is joined; radii run evenly from end to end
    """

    @functools.cache
    def beside(k: int) -> Image:
        return exact_distance(~views[k].mask)

    def bridge(a: FreeEnd, b: FreeEnd, line: Points) -> Branch | None:
        if not all(_runs_on(line, view.carm, beside(k)) for k, view in enumerate(views)):
            return None
        m = len(line)
        return Branch(
            points_mm=line, radius_mm=np.linspace(a.radius_mm, b.radius_mm, m),
            sigma_mm=np.full(m, np.nan), confidence=np.full(m, UNTOLD),
            start=a.node, end=b.node,
        )  # fmt: skip

    least_mm = LEAST_FITTED_MM if fitted else LEAST_PART_MM
    return joined_ends(tree, bridge, MOST_GAP_MM, least_mm)


def _runs_on(line: Points, carm: CArm, beside: Image) -> bool:
    """Whether a picture's vessel goes on from one end of a line to the other, near it all along.

    ``beside`` is each pixel's distance from vessel.
    """
    pixels, depth = carm.project(line)
    inside = (pixels >= 0).all() and (pixels < beside.shape[::-1]).all()
    if not (inside and (depth > 1.0).all()):
        return False
    per_mm = float(carm.px_per_mm(depth.mean()))
    wide = round(2 * OFF_MM * per_mm)
    near = np.zeros(beside.shape, np.uint8)
    course = np.rint(pixels).astype(np.int32)
    cv2.polylines(near, [course], isClosed=False, color=1, thickness=max(wide, 1))
    # Within so much of vessel on either side a break is none.
    near[beside > 0.5 * BREAK_MM * per_mm] = 0
    parts = cv2.connectedComponents(near, connectivity=8)[1]
    shown = np.stack(np.nonzero(parts)[::-1], axis=1)
    if not len(shown):
        return False
    first, last = (
        parts[tuple(shown[np.argmin(np.linalg.norm(shown - end, axis=1))][::-1])]
        for end in pixels[[0, -1]]
    )
    return bool(first == last)
