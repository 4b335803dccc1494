"""More vessel than a heart has: ribs and edges that were taken for vessels.

The coronary arteries of both sides hold about 3 ml (computed tomography), large ones twice that,
and what pictures resolve of them is about a metre long. The volume seen in a view is its paths
summed, whatever the direction: foreshortening and overlap change nothing of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gcar_deploy.config import QualityOptions
from gcar_deploy.errors import RefusedError
from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.tree.tree import Tree

#: vessel in a view, mean of the views: volume, and length of line. Both have to be exceeded: wide
#: arteries hold much on a short way (two real trees, drawn too wide: 7.5 ml on 480 mm), and bubbles
#: beside arteries make long lines that are thin (a real pair of a phantom: 750 mm of 2 ml). Real
#: frames of unknown scale, at the largest that it may be: 11 ml on 815 mm in one of 40, 6.9 ml on
#: 865 mm in the longest. Generated pairs with ribs taken for vessels: from 11 ml on 810 mm on
MOST_ML, MOST_LINE_MM = 10.0, 750.0
_ADVICE = "give masks of the vessels, or take other frames or another segmenter"


def check_found(views: Sequence[VesselImage]) -> None:
    """Refuse views in which far more was found than coronary arteries.

    Raises
    ------
    RefusedError
        All views are of found vessels, and these exceed ``MOST_ML`` and ``MOST_LINE_MM``.
    """
    if _given(views):
        return
    volume = [_volume_ml(view) for view in views]
    length = [_line_mm(view) for view in views]
    if np.mean(volume) > MOST_ML and np.mean(length) > MOST_LINE_MM:
        told = "; ".join(
            f"view {view.view_id}: {ml:.0f} ml, {mm:.0f} mm of line"
            for view, ml, mm in zip(views, volume, length, strict=True)
        )
        raise RefusedError(
            f"more was taken for vessel than any heart has ({told}; the coronary arteries "
            "of both sides hold about 3 ml): ribs, a diaphragm or edges? If the pixel sizes are "
            f"right, {_ADVICE}"
        )


def check_length(tree: Tree, views: Sequence[VesselImage], options: QualityOptions) -> None:
    """Refuse a tree of found vessels that is longer than the coronary arteries of a heart.

    Raises
    ------
    RefusedError
        More than ``max_length_mm`` of vessel.
    """
    if not _given(views) and tree.length_mm > options.max_length_mm:
        raise RefusedError(
            f"{tree.length_mm:.0f} mm of vessel in {len(tree.branches)} branches are more than any "
            f"coronary tree has (at most {options.max_length_mm:g} mm are believed): what is no "
            f"vessel was taken for one; {_ADVICE}"
        )


def _given(views: Sequence[VesselImage]) -> bool:
    """Whether someone said of a view what is vessel in it: nothing was mistaken there."""
    return any(view.calibrated or view.kind == "mask" for view in views)


def _volume_ml(view: VesselImage) -> float:
    area_mm2 = view.carm.pixel_at_isocenter_mm**2
    return float(view.path_mm.sum(dtype=np.float64)) * area_mm2 / 1000.0


def _line_mm(view: VesselImage) -> float:
    return float(skel.arc_length(view.skeleton).sum()) * view.carm.pixel_at_isocenter_mm
