"""All that is measured of a finished tree, once, for whoever writes or shows it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.config import LesionBorders
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.measure.bifurcation import Bifurcation, bifurcations
from gcar_deploy.measure.borders import marked_lesions
from gcar_deploy.measure.further_view import FurtherView, best_further_view
from gcar_deploy.measure.lumen import (
    BifurcationAngle,
    BranchLumen,
    bifurcation_angles,
    foreshortening,
    tree_lumens,
)
from gcar_deploy.measure.naming import BranchName, read_anatomy
from gcar_deploy.measure.sections import Sections, sections_of_radii
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Points, Scalars


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """Figures of a tree and of the views it was made from.

    Attributes
    ----------
    names : per branch its name (LM, LAD, LCx, RCA) with its probability, or None
    lumens : per branch its diameters, measured from its inlet
    bifurcations : where one branch becomes two, each with its three segments
    on_marks : what became of each lesion the user marked, as sentences
    angles : between each two branches that meet
    hidden : (branches, views) share of a branch's length that a view hides, 0 .. 1
    residual_mm : (views, n) distance of each point of ``tree.points()`` from the view's vessels
        at the isocentre; NaN outside the picture
    further : the view to take next; None without a branch
    """

    names: tuple[BranchName | None, ...]
    lumens: tuple[BranchLumen, ...]
    bifurcations: tuple[Bifurcation, ...]
    on_marks: tuple[str, ...]
    angles: tuple[BifurcationAngle, ...]
    hidden: Array
    residual_mm: Array
    further: FurtherView | None


def measured(
    tree: Tree,
    views: Sequence[VesselImage],
    sections: Sequence[Sections] | None = None,
    marks: Sequence[LesionBorders] = (),
) -> Measured:
    """Measure a tree.

    Parameters
    ----------
    tree : Tree, mm LPS, branches from their inlets (``measure.inlet``)
    views : one or more, with the geometry that was used
    sections : of each branch (``measure.sections``); None takes the tree's own radii
    marks : lesion borders that the user set in the pictures
    """
    points, carms = tree.points(), [view.carm for view in views]
    sections = sections_of_radii(tree) if sections is None else sections
    marked, missed = marked_lesions(tree, sections, carms, marks)
    lumens = tree_lumens(tree, sections, marked)
    return Measured(
        names=read_anatomy(tree).names,
        lumens=lumens,
        bifurcations=bifurcations(tree, lumens),
        on_marks=(*_marked_notes(lumens), *missed),
        angles=bifurcation_angles(tree),
        hidden=np.stack([foreshortening(tree, carm) for carm in carms], axis=1),
        residual_mm=np.stack([residuals(points, view) for view in views]),
        further=best_further_view(tree, carms),
    )


def _marked_notes(lumens: Sequence[BranchLumen]) -> list[str]:
    """Say which lesions have the user's borders, and which found ones gave way to them."""
    out = []
    for k, lumen in enumerate(lumens, start=1):
        for own in (one for one in lumen.lesions or () if one.marked):
            first, last = own.lesion_mm
            gone = [f"{one.stenosis_percent:.0f} % at {one.minimal_at_mm:.1f} mm"
                    for one in lumen.replaced if first <= one.minimal_at_mm <= last]  # fmt: skip
            said = f"of the user: borders of a lesion of branch {k}, {first:.1f} - {last:.1f} mm"
            out.append(said + (f"; found there: {', '.join(gone)}" if gone else ""))
    return out


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
