"""All that is measured of a finished tree, once, for whoever writes or shows it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.measure.further_view import FurtherView, best_further_view
from gcar_deploy.measure.lumen import (
    BifurcationAngle,
    BranchLumen,
    bifurcation_angles,
    branch_lumen,
    foreshortening,
)
from gcar_deploy.measure.naming import BranchName, read_anatomy
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Points, Scalars


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """Figures of a tree and of the views it was made from.

    Attributes
    ----------
    names : per branch its name (LM, LAD, LCx, RCA) with its probability, or None
    lumens : per branch its diameters, measured from its inlet
    angles : between each two branches that meet
    hidden : (branches, views) share of a branch's length that a view hides, 0 .. 1
    residual_mm : (views, n) distance of each point of ``tree.points()`` from the view's vessels
        at the isocentre; NaN outside the picture
    further : the view to take next; None without a branch
    """

    names: tuple[BranchName | None, ...]
    lumens: tuple[BranchLumen, ...]
    angles: tuple[BifurcationAngle, ...]
    hidden: Array
    residual_mm: Array
    further: FurtherView | None


def measured(tree: Tree, views: Sequence[VesselImage]) -> Measured:
    """Measure a tree.

    Parameters
    ----------
    tree : Tree, mm LPS, branches from their inlets (``measure.inlet``)
    views : one or more, with the geometry that was used
    """
    points = tree.points()
    return Measured(
        names=read_anatomy(tree).names,
        lumens=tuple(branch_lumen(branch) for branch in tree.branches),
        angles=bifurcation_angles(tree),
        hidden=np.array(
            [[foreshortening(branch, view.carm) for view in views] for branch in tree.branches]
        ).reshape(-1, len(views)),
        residual_mm=np.stack([residuals(points, view) for view in views]),
        further=best_further_view(tree, [view.carm for view in views]),
    )


def residuals(points_mm: Points, view: VesselImage) -> Scalars:
    """(n,) distance of reprojected points from the view's skeleton, mm at the isocentre.

    NaN outside the picture, and everywhere where the view has no skeleton.
    """
    out: Scalars = np.full(len(points_mm), np.nan)
    if not view.skeleton.any():
        return out
    distance = cv2.distanceTransform((~view.skeleton).astype(np.uint8), cv2.DIST_L2, 5)
    pixels, depth = view.carm.project(points_mm)
    column, row = np.rint(np.nan_to_num(pixels, posinf=-1, neginf=-1)).T
    rows, columns = distance.shape
    inside = (depth > 1.0) & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    at = row[inside].astype(int), column[inside].astype(int)
    out[inside] = distance[at] * view.carm.pixel_at_isocenter_mm
    return out
