"""What can be said of pictures and geometry before any reconstruction."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gcar_deploy.config import RunOptions, check_options
from gcar_deploy.errors import GcarError
from gcar_deploy.geometry.carm import CArm, separation_deg
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.observability import silent_errors
from gcar_deploy.geometry.own_frame import own_frame
from gcar_deploy.geometry.scene import Scene
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.extract import asked_network, asks_network, extract_vessels
from gcar_deploy.imaging.net import load_segmenter
from gcar_deploy.imaging.own_frame import in_own_frame
from gcar_deploy.imaging.polarity import with_polarity
from gcar_deploy.inputs.drawn import Drawn
from gcar_deploy.inputs.pictures import Geometry, Mask, prepare
from gcar_deploy.pose import landmark_pixels, register
from gcar_deploy.predict import Predictor, load_predictor, quick_tree, seen_by_all
from gcar_deploy.quality import (
    check_candidates,
    check_found,
    check_gross_scale,
    check_views,
)
from gcar_deploy.stopwatch import Stopwatch
from gcar_deploy.tree.tree import Tree


@dataclasses.dataclass(kw_only=True)
class Inspection:
    """Findings per view and per pair, warnings, and the error that ``gcar run`` would end with.

    Attributes
    ----------
    views : one dict per view: id, name, magnification, pixel_at_isocenter_mm, coverage,
        vessel_share (None before its vessels were found)
    pairs : one dict per pair: first, second, separation_deg, disagreement, shift_mm, after_shift
    warnings : sentences
    silent : errors of the geometry that no picture can show, with their effect
    error : what ``gcar run`` would raise, or None
    """

    views: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    pairs: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    warnings: list[str] = dataclasses.field(default_factory=list)
    silent: list[str] = dataclasses.field(default_factory=list)
    error: GcarError | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-able dict."""
        error = self.error
        return {
            "schema": "gcar-validation/1",
            "would": "reconstruct" if error is None else "refuse",
            "exit_code": 0 if error is None else error.exit_code,
            "reason": None if error is None else str(error),
            "views": self.views,
            "pairs": self.pairs,
            "warnings": self.warnings,
            "silent_errors": self.silent,
        }


def inspect_files(
    pictures: Sequence[str | Path],
    geom: Geometry | None,
    options: RunOptions | None = None,
    masks: Mapping[int, Mask] | None = None,
    drawn: Mapping[int, Drawn] | None = None,
) -> Inspection:
    """Read and judge; errors end the inspection and stand in it, nothing is raised."""
    options = options or RunOptions()
    found = Inspection()
    try:
        check_options(options)
        angiograms, grid, warnings = prepare(pictures, geom, options, masks, drawn)
        found.warnings += warnings
        carms = [a.carm for a in angiograms]
        for a in angiograms:
            found.views.append(
                {
                    "id": a.view_id,
                    "name": a.carm.clinical_name(),
                    "magnification": a.carm.magnification,
                    "pixel_at_isocenter_mm": a.carm.pixel_at_isocenter_mm,
                    "coverage": volume_coverage(a.carm, grid),
                    "vessel_share": None,
                }
            )
        for a, b in itertools.combinations(angiograms, 2):
            found.pairs.append(
                {
                    "first": a.view_id,
                    "second": b.view_id,
                    "separation_deg": separation_deg(a.carm, b.carm),
                    "disagreement": None,
                    "shift_mm": None,
                    "after_shift": None,
                }
            )
        found.silent += silent_errors(carms)
        found.warnings += check_views(angiograms, options.quality)
        wanted = options.imaging.segmenter if asks_network(angiograms) else "classic"
        views, loaded = [], load_segmenter(wanted)
        segmenter, missing = asked_network(angiograms, options.imaging, loaded)
        found.warnings += missing
        landmark_pixels(options.landmarks, carms)  # named as the user numbers the views
        for marks in (options.same_branch, options.ostia):
            landmark_pixels(marks, carms)
        frame = own_frame(carms, [a.sha256 for a in angiograms])
        own, asked = in_own_frame(frame, angiograms, options)
        own = with_polarity(own)
        for k, angiogram in zip(frame.order, own, strict=True):
            view = extract_vessels(angiogram, options.imaging, segmenter)
            found.views[k]["vessel_share"] = float(view.mask.mean())
            views.append(view)
        check_found(views)
        found.warnings += _registered(found, own, views, frame.grid(grid), asked)
    except GcarError as error:
        found.error = error
    return found


def volume_coverage(carm: CArm, grid: Grid) -> float:
    """Share of the volume that a view sees, from a lattice of 16^3 points."""
    axes = [(np.arange(16) + 0.5) / 16 * n - 0.5 for n in grid.shape]
    index = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    pixels, depth = carm.project(grid.index2world(index))
    return float((carm.shows(pixels) & (depth > 0)).mean())


def _registered(
    found: Inspection, angiograms: Sequence[Angiogram], views: Sequence[VesselImage],
    grid: Grid, options: RunOptions,
) -> list[str]:  # fmt: skip
    """Register the views as ``run`` does, and state what that says of each pair."""

    def tree_of(placed: Sequence[VesselImage]) -> Tree:
        return quick_tree(placed, grid, predictor(), options, Stopwatch(()))

    @functools.cache
    def predictor() -> Predictor | None:
        return load_predictor(None, options.predict)

    placed = register(angiograms, views, options, tree_of)
    for view, pose in zip(placed.views, placed.poses, strict=True):
        both = {placed.views[pose.partner].view_id, view.view_id}
        for pair in found.pairs:
            if {pair["first"], pair["second"]} == both:
                pair["disagreement"] = pose.before
                pair["shift_mm"] = pose.shift_mm
                pair["after_shift"] = pose.after
    placed.or_refuse()
    marked = placed.marks(options)
    with placed.hinting():
        hull = seen_by_all(placed.views, grid, marked, predictor()).hull
        check_candidates(len(hull), hull.lattice, marked.quality)
        check_gross_scale(angiograms, views)
    return list(placed.findings)


def describe_scene(scene: Scene) -> dict[str, Any]:
    """Say what a geometry holds, as a JSON-able dict: views, pairs, volume, warnings, silence."""
    carms = [view.carm for view in scene.views]
    grid = scene.volume_grid()
    return {
        "schema": "gcar-scene-description/1",
        "views": [
            {
                "id": view.id,
                "name": view.carm.clinical_name(),
                "sod_mm": view.carm.sod_mm,
                "sdd_mm": view.carm.sdd_mm,
                "rows": view.carm.rows,
                "columns": view.carm.columns,
                "pixel_spacing_mm": list(view.carm.pixel_spacing_mm),
                "pixel_at_isocenter_mm": view.carm.pixel_at_isocenter_mm,
                "kind": view.intensity.kind,
            }
            for view in scene.views
        ],
        "pairs": [
            {"first": a.id, "second": b.id, "separation_deg": separation_deg(a.carm, b.carm)}
            for a, b in itertools.combinations(scene.views, 2)
        ],
        "volume": {
            "center_mm": list(grid.center_mm),
            "size_mm": list(grid.size_mm),
            "shape": list(grid.shape),
            "given": scene.grid is not None,
        },
        "warnings": list(scene.warnings),
        "silent_errors": list(silent_errors(carms)),
    }
