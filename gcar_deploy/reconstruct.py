"""The composition: from pictures that know their C-arm to a tree with its uncertainty.

vessels of every view -> pose between the views -> points that all views see as vessel
-> which of them are vessel (learned, or by thinning) -> Gaussians and tubes refined against
the pictures -> tree, volume -> quality
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from gcar_deploy.config import RunOptions, check_options
from gcar_deploy.errors import NumericalError, UsageError
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.extract import asked_network, extract_vessels
from gcar_deploy.imaging.net import Segmenter
from gcar_deploy.imaging.resample import sampled_path
from gcar_deploy.measure.inlet import from_inlets
from gcar_deploy.output.result import Result
from gcar_deploy.pose.agreement import (
    agreeing,
    check_consistency,
    order_of,
    poses_between,
    with_hint,
)
from gcar_deploy.pose.bundling import bundled, posed
from gcar_deploy.pose.landmarks import landmark_pixels
from gcar_deploy.pose.pairwise import Pose
from gcar_deploy.predict.center_predictor import Predictor, SingleViewPredictor
from gcar_deploy.predict.decision import decide
from gcar_deploy.predict.encoding import Encoded, encode
from gcar_deploy.predict.hull import Candidates, cubic_lattice, visual_hull
from gcar_deploy.predict.lattices import mean_evidence, near_evidence, shifted_lattice
from gcar_deploy.predict.single_view import merge_views
from gcar_deploy.predict.thinning import thin_hull
from gcar_deploy.quality import alternatives
from gcar_deploy.quality import gates as quality
from gcar_deploy.stopwatch import OnProgress, Stopwatch
from gcar_deploy.tree.centerline import build_tree
from gcar_deploy.tree.tree import Tree, empty_tree
from gcar_deploy.tubes.model import footprint, tubes_of
from gcar_deploy.tubes.refine import Refined, refine, refined_volume
from gcar_deploy.types import Image, Mask

#: stages with their usual share of the time
STAGES = (
    ("vessels", 3.0), ("pose", 2.0), ("candidates", 1.0), ("centers", 2.0), ("refine", 6.0),
    ("tree", 1.0), ("quality", 0.5),
)  # fmt: skip
#: what is kept of a deadline, as shares of the time that all before the refinement took: for what
#: follows its last step (sigma, tree, volume, quality), for its start, and for a tree without it
FINISH_SHARE, BEGIN_SHARE, UNREFINED_SHARE = 0.9, 0.5, 0.7
_FALLBACK = "no model was used: depth was decided by thinning the visual hull"


def reconstruct(
    angiograms: Sequence[Angiogram],
    grid: Grid,
    options: RunOptions,
    *,
    predictor: Predictor | None = None,
    segmenter: Segmenter | None = None,
    on_progress: OnProgress | None = None,
    deadline_s: float | None = None,
    cancel: Callable[[], bool] | None = None,
    used_s: float = 0.0,
) -> Result:
    """Reconstruct the coronary tree that all views show.

    Parameters
    ----------
    angiograms : 2 or more pictures with their C-arms
    grid : Grid of the volume that is asked for
    options : RunOptions
    predictor : of either kind, or None to thin the visual hull instead
    segmenter : Segmenter, where ``options.imaging.segmenter`` asks for one
    on_progress : called with (stage, share of the work done)
    deadline_s : seconds after which the refinement ends with what it has
    cancel : called often, also from another thread; True ends the work with CancelledError
    used_s : seconds that reading the pictures took, part of the deadline and of ``total``

    Raises
    ------
    RefusedError
        No tree can honestly be made of these views.
    CancelledError
        Cancelled, or late before there was a result.
    """
    if len(angiograms) < 2:
        raise UsageError(f"{len(angiograms)} picture given; two or more are needed")
    check_options(options)
    landmark_pixels(options.landmarks, [a.carm for a in angiograms])  # refuse before any work
    watch = Stopwatch(STAGES, on_progress=on_progress, deadline_s=deadline_s, cancel=cancel,
                      used_s=used_s)  # fmt: skip
    findings = quality.check_views(angiograms, options.quality)
    with watch.stage("vessels") as report:
        used, missing = asked_network(angiograms, options.imaging, segmenter)
        findings += missing
        views = _vessels(angiograms, options, used, report, watch)
    with watch.stage("pose"):
        views, poses, apart = agreeing(angiograms, views, options)
        findings += apart
        poses = _bundled(views, poses, grid, predictor, options, watch)
        order, hint = order_of(views, poses, options)
        findings += order
        findings += quality.check_poses(
            views, [(p.shift_mm, p.turn_deg) for p in poses], options.quality
        )
        with with_hint(hint):
            findings += check_consistency(
                views, [p.after for p in poses], options.quality, [p.partner for p in poses]
            )
        views = [posed(view, pose) for view, pose in zip(views, poses, strict=True)]
    with watch.stage("candidates"):
        hull, known = seen_by_all(views, grid, options)
        with with_hint(hint):
            quality.check_candidates(len(hull), hull.lattice, options.quality)
        watch.check()
        encoded = encode(hull, known)
    with watch.stage("centers"):
        centers, told = _centers(predictor, hull, encoded, views, known, options, watch)
        if predictor is None:
            findings.append(_FALLBACK)
    with watch.stage("refine") as report:
        before_s = watch.elapsed_s
        watch.require(UNREFINED_SHARE * before_s)
        how = options.refine
        if watch.left_s < (BEGIN_SHARE + FINISH_SHARE) * before_s:
            how = dataclasses.replace(how, refiner="none")
            findings.append("the deadline left no time to refine")
        refined = refine(
            centers, views, how, on_progress=report, tree_options=options.tree,
            should_stop=watch.leaving(FINISH_SHARE * before_s),
        )  # fmt: skip
        if refined.status == "failed":
            raise NumericalError("the refinement left the finite numbers")
        if refined.status == "stopped":
            findings.append("the deadline ended the refinement early")
    with watch.stage("tree", keep_if_late=True):
        tree = _tree(refined, centers, options)
        quality.check_tree(tree, options.quality)
        if watch.cancelled:
            watch.check()
        volume = refined_volume(refined, views, grid, how)
    with watch.stage("quality", keep_if_late=True):
        lumen = [_lumen(tree, view, options) for view in views]
        worst = max(p.after for p in poses)
        open_ = alternatives.exchanges(tree, [view.carm for view in views])
        elsewhere = None if told is None else alternatives.evidence_elsewhere(
            tree, told, encoded.ray, encoded.weight
        )  # fmt: skip
        findings += alternatives.findings(open_, elsewhere)
        with with_hint(hint):
            judged = quality.assess(tree, views, lumen, findings, worst, options.quality)
        tree = from_inlets(tree)
    return Result(
        quality=judged, tree=tree, gaussians=refined.gaussians, volume=volume, grid=grid,
        angiograms=tuple(angiograms), views=tuple(views), poses=poses,
        seconds={**watch.seconds, "total": watch.elapsed_s},
        counts={
            "candidates": len(hull), "gaussians": len(refined.gaussians.means_mm),
            "branches": len(tree.branches), "steps": refined.steps,
            "rejected_steps": refined.rejected_steps, "alternatives": len(open_),
        },
        losses=tuple(refined.losses), predictor=centers.source, refiner=how.refiner,
        model=None if predictor is None else predictor.model.label,
        segmenter=None if used is None else used.session.model.label,
        notes=(), options=options,
    )  # fmt: skip


def cell_mm(grid: Grid, options: RunOptions) -> float:
    """Return the edge of the lattice: the grid's own where the predictor knows such cells."""
    own = float(np.mean(grid.spacing_mm))
    return float(np.clip(own, options.predict.min_cell_mm, options.predict.max_cell_mm))


def seen_by_all(
    views: Sequence[VesselImage], grid: Grid, options: RunOptions
) -> tuple[Candidates, list[tuple[CArm, Image, bool]]]:
    """Points that all views see as vessel; per view its C-arm, sampled path and calibration."""
    lattice = cubic_lattice(grid, cell_mm(grid, options))
    seen = [sampled_path(view, float(lattice.spacing_mm[0])) for view in views]
    hull = visual_hull(seen, lattice, options.candidates)
    return hull, [(*s, v.calibrated) for s, v in zip(seen, views, strict=True)]


def _centers(
    predictor: Predictor | None,
    hull: Candidates,
    encoded: Encoded,
    views: Sequence[VesselImage],
    known: Sequence[tuple[CArm, Image, bool]],
    options: RunOptions,
    watch: Stopwatch,
) -> tuple[CenterPoints, CenterPoints | None]:
    """Which of the hull's points are vessel, and what the multi-view predictor said of each."""
    if predictor is None:
        return thin_hull(hull, encoded, options.candidates), None
    stop = watch.question
    if isinstance(predictor, SingleViewPredictor):
        alone = predictor.predict([(view.carm, view.path_mm) for view in views], stop)
        single = options.predict.single
        return merge_views(alone, hull, encoded, options.candidates, single), None
    told = predictor.predict(hull, encoded, stop)
    others = []
    for look in range(1, options.predict.looks):
        lattice = shifted_lattice(hull.lattice, look)
        near = near_evidence(hull, told.confidence, look, options.predict.look_again)
        other = visual_hull([(c, p) for c, p, _ in known], lattice, options.candidates, near)
        if len(other):
            others.append((other, predictor.predict(other, encode(other, known), stop)))
    told = mean_evidence(told, others)
    error = max(view.path_error for view in views)
    return decide(told, encoded, error, options.decide), told


def _vessels(
    angiograms: Sequence[Angiogram],
    options: RunOptions,
    segmenter: Segmenter | None,
    report: Callable[[float], None],
    watch: Stopwatch,
) -> list[VesselImage]:
    views = []
    segmenter = segmenter and segmenter.watched(watch.question)
    for angiogram in angiograms:
        watch.check()
        views.append(extract_vessels(angiogram, options.imaging, segmenter))
        report(len(views) / len(angiograms))
    return views


def _bundled(
    views: Sequence[VesselImage], poses: tuple[Pose, ...], grid: Grid,
    predictor: Predictor | None, options: RunOptions, watch: Stopwatch,
) -> tuple[Pose, ...]:  # fmt: skip
    """Poses of three and more views from their tree, and what the profiles say of them."""

    def tree_of(placed: Sequence[VesselImage]) -> Tree:
        hull, known = seen_by_all(placed, grid, options)
        watch.check()
        if len(hull) == 0:
            return empty_tree()
        # One look is enough to say where the views stand.
        quick = dataclasses.replace(options, predict=dataclasses.replace(options.predict, looks=1))
        encoded = encode(hull, known)
        centers, _ = _centers(predictor, hull, encoded, placed, known, quick, watch)
        return build_tree(centers, options.tree)

    found = bundled(views, poses, tree_of, options)
    return poses if found == poses else poses_between(views, options, found)


def _tree(refined: Refined, centers: CenterPoints, options: RunOptions) -> Tree:
    return refined.tree if refined.tree is not None else build_tree(centers, options.tree)


def _lumen(tree: Tree, view: VesselImage, options: RunOptions) -> Mask:
    smallest = options.imaging.path_threshold_pixels * view.carm.pixel_at_isocenter_mm
    path = footprint(tubes_of(tree), view.carm, 1.0).image((view.carm.rows, view.carm.columns))
    inside: Mask = path > smallest
    return inside
