"""What every stage of a reconstruction made, as pictures and VTP files, for whoever debugs a case.

Each step is written as soon as it is there, so those before a refusal are kept as well. Points and
lines are in mm LPS, in the coordinates of the geometry; pictures are named by the id of their view.

========================================== ======================================================
``1-vessels-viewID-mask``, ``-skeleton``   what was found in the picture
``1-vessels-viewID-path``                  16 bit, 0.01 mm of vessel along the ray a count
``1-vessels-viewID-vesselness``            raw pictures: ridge response, the strongest white
``1-vessels-viewID-catheter``              raw pictures: what was left out
``2-pose-viewID-mask``                     what is left after views were brought to agree
``2-pose.vtp``                             beams as corrected: source, middle, detector
``3-hull.vtp``                             points that all views see
``4-points.vtp``                           ... with the decided confidence and the predictor's own
``5-tree-before.vtp``, ``-after.vtp``      before and after the refinement
========================================== ======================================================
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np

from gcar_deploy.errors import GcarError
from gcar_deploy.geometry.own_frame import OwnFrame
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.own_frame import found_as_given
from gcar_deploy.imaging.vessels import Vessels
from gcar_deploy.output.folder import check_target
from gcar_deploy.output.overlay import png_bytes
from gcar_deploy.output.vtp import poly_data
from gcar_deploy.pose import Registered
from gcar_deploy.predict import Centers, Seen
from gcar_deploy.steps import Step
from gcar_deploy.tree.centerline import build_tree
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Points

_Files: TypeAlias = Iterator[tuple[str, bytes]]
#: a count of the pictures of path lengths, mm
PATH_COUNT_MM = 0.01


class StepFolder:
    """Writes steps into a new folder; see the head of this file.

    Parameters
    ----------
    folder : Path that does not exist

    Raises
    ------
    UsageError
        As ``check_target``.
    GcarError
        The disk refused, at once or at a later step.
    """

    def __init__(self, folder: Path) -> None:
        check_target(folder, force=False)
        self._folder = folder
        self._frame: OwnFrame | None = None
        try:
            folder.mkdir(parents=True)
        except OSError as error:
            raise self._refused(error) from None

    def __call__(self, step: Step) -> None:
        """Write a step."""
        if isinstance(step, OwnFrame):
            self._frame = step
            return
        if self._frame is None:
            raise ValueError("a step came before the frame that it stands in")
        try:
            for name, data in _files(step, self._frame):
                (self._folder / name).write_bytes(data)
        except OSError as error:
            raise self._refused(error) from None

    def _refused(self, error: OSError) -> GcarError:
        return GcarError(f"{self._folder} cannot be written ({error.strerror or error})")


def _files(step: Step, frame: OwnFrame) -> _Files:
    if isinstance(step, Vessels):
        for view in found_as_given(frame, step.views):
            yield from _pictures(view)
    elif isinstance(step, Registered):
        for view in found_as_given(frame, step.views):
            yield f"2-pose-view{_name(view)}-mask.png", _drawn(view.mask)
        sdd_mm = [frame.given[k].sdd_mm for k in frame.order]
        each = [_beam(*one) for one in zip(step.views, sdd_mm, strict=True)]
        names = [_name(view) for view in step.views]
        beams = np.concatenate(each) + frame.origin_mm
        yield "2-pose.vtp", poly_data(beams, [3] * len(names), {}, {"View": names})
    elif isinstance(step, Seen):
        yield "3-hull.vtp", poly_data(step.hull.points_mm + frame.origin_mm, None, {}, {})
    elif isinstance(step, Centers):
        data = {"Confidence": step.points.confidence}
        if step.evidence is not None:
            data["Evidence"] = step.evidence.points.confidence
        yield "4-points.vtp", poly_data(step.points.points_mm + frame.origin_mm, None, data, {})
    elif not isinstance(step, OwnFrame):
        before = build_tree(step.centers)
        yield "5-tree-before.vtp", _lines(before.moved(frame.origin_mm))
        yield "5-tree-after.vtp", _lines(step.tree.moved(frame.origin_mm))


def _name(view: VesselImage) -> str:
    return re.sub(r"[^\w-]", "_", view.view_id, flags=re.ASCII)


def _pictures(view: VesselImage) -> _Files:
    head = f"1-vessels-view{_name(view)}"
    yield f"{head}-mask.png", _drawn(view.mask)
    yield f"{head}-skeleton.png", _drawn(view.skeleton)
    counts = np.clip(np.rint(view.path_mm / PATH_COUNT_MM), 0, 65535)
    yield f"{head}-path.png", png_bytes(counts.astype(np.uint16))
    if view.vesselness is not None:
        yield f"{head}-vesselness.png", _drawn(view.vesselness)
    if view.catheter is not None:
        yield f"{head}-catheter.png", _drawn(view.catheter)


def _drawn(picture: Array) -> bytes:
    """Encode a picture whose largest value is white."""
    most = max(float(picture.max()), 1e-9)
    return png_bytes(np.rint(np.clip(picture / most, 0, 1) * 255).astype(np.uint8))


def _beam(view: VesselImage, sdd_mm: float) -> Points:
    """(3, 3) source, the point of the central ray nearest to the scene's middle, detector."""
    source, ray = view.carm.source_mm, view.carm.axes[2]
    return np.stack([source, source - (source @ ray) * ray, source + sdd_mm * ray])


def _lines(tree: Tree) -> bytes:
    point_data = {
        name: np.concatenate([np.zeros(0), *(getattr(branch, key) for branch in tree.branches)])
        for name, key in (("Radius", "radius_mm"), ("Sigma", "sigma_mm"),
                          ("Confidence", "confidence"))
    }  # fmt: skip
    numbers = np.arange(1, len(tree.branches) + 1, dtype=np.int64)
    sizes = [len(branch) for branch in tree.branches]
    return poly_data(tree.points(), sizes, point_data, {"BranchId": numbers})
