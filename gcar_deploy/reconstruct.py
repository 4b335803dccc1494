"""The composition: from pictures that know their C-arm to a tree with its uncertainty.

vessels of every view -> pose between the views -> points that all views see as vessel
-> which of them are vessel (learned, or by thinning) -> Gaussians and tubes refined against
the pictures -> tree, volume -> quality
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gcar_deploy.beside import started, waited_for
from gcar_deploy.config import RunOptions, check_options
from gcar_deploy.errors import RefusedError, UsageError
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.own_frame import own_frame
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.net import Segmenter
from gcar_deploy.imaging.own_frame import in_own_frame
from gcar_deploy.imaging.polarity import with_polarity
from gcar_deploy.imaging.vessels import find_vessels
from gcar_deploy.measure import (
    from_inlets,
    idle_ostia,
    joined_over_lesions,
    measure_sections,
    read_signal,
    thin_ostia,
    with_diameters,
)
from gcar_deploy.pose import landmark_pixels, marked_places, register
from gcar_deploy.predict import Predictor, find_centers, quick_tree, seen_by_all
from gcar_deploy.quality import (
    OK,
    Part,
    Remark,
    check_candidates,
    check_found,
    check_gross_scale,
    check_length,
    check_tree,
    check_views,
    doubted,
    judge,
    kind_of,
)
from gcar_deploy.reconstruction import Reconstruction
from gcar_deploy.second_look import SecondLook
from gcar_deploy.steps import OnStep, Step
from gcar_deploy.stopwatch import OnProgress, Stopwatch
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes import refine, refined_volume

#: stages with their usual share of the time
STAGES = (
    ("vessels", 3.0), ("pose", 2.0), ("candidates", 1.0), ("centers", 2.0), ("refine", 6.0),
    ("quality", 2.0), ("diameters", 0.5), ("tree", 1.0),
)  # fmt: skip


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
    on_step: OnStep | None = None,
) -> Reconstruction:
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
    on_step : told what each stage hands on

    Raises
    ------
    UsageError
        Fewer than two pictures, an option out of its range, or a mark that lies in no picture.
    RefusedError
        No tree can honestly be made of these views.
    NumericalError
        The refinement failed.
    CancelledError
        Cancelled, or late before there was a result.
    """
    if len(angiograms) < 2:
        raise UsageError(f"{len(angiograms)} picture given; two or more are needed")
    check_options(options)
    landmark_pixels(options.landmarks, [a.carm for a in angiograms])  # refuse before any work
    for marks in (options.same_branch, options.ostia):
        landmark_pixels(marks, [a.carm for a in angiograms])
    watch = Stopwatch(STAGES, on_progress=on_progress, deadline_s=deadline_s, cancel=cancel,
                      used_s=used_s)  # fmt: skip
    frame = own_frame([a.carm for a in angiograms], [a.sha256 for a in angiograms])
    seen, asked = in_own_frame(frame, angiograms, options)
    keep = on_step or _nothing
    keep(frame)
    found = _reconstructed(seen, frame.grid(grid), asked, (predictor, segmenter), watch, keep)
    return found.as_given(frame, angiograms, grid, options)


def _reconstructed(
    angiograms: Sequence[Angiogram],
    grid: Grid,
    options: RunOptions,
    models: tuple[Predictor | None, Segmenter | None],
    watch: Stopwatch,
    keep: OnStep,
) -> Reconstruction:
    """Reconstruct a scene that stands in its own frame."""
    predictor, segmenter = models

    def tree_of(views: Sequence[VesselImage]) -> Tree:
        return quick_tree(views, grid, predictor, options, watch)

    findings = check_views(angiograms, options.quality)
    with watch.stage("vessels") as report:
        angiograms = with_polarity(angiograms)
        vessels = find_vessels(angiograms, options.imaging, segmenter, watch, report)
        keep(vessels)
        check_found(vessels.views)
    with watch.stage("pose"):
        placed = register(angiograms, vessels.views, options, tree_of, watch.check)
        keep(placed)
        placed.or_refuse()
        options = placed.marks(options)
    with watch.stage("candidates"), placed.hinting():
        seen = seen_by_all(placed.views, grid, options, predictor)
        keep(seen)
        check_candidates(len(seen.hull), seen.hull.lattice, options.quality)
    with placed.hinting():
        check_gross_scale(angiograms, vessels.views)
    with watch.stage("centers"):
        centers = find_centers(seen, predictor, options, watch)
        keep(centers)
    told = None if centers.evidence is None else centers.evidence.points
    with watch.stage("refine") as report, placed.hinting():
        refined = refine(
            centers.points, placed.views, options.refine, report, watch.budget(), told
        ).or_fail()
        signals = [
            read_signal(a, v)
            for a, v in zip(placed.pictures(angiograms), placed.views, strict=True)
        ]
        refined = refined.with_tree(joined_over_lesions(refined.tree, signals))
        refined, missed = refined.without(options.deleted_mm)
        keep(refined)
        if options.deleted_mm and not refined.tree.branches:
            raise RefusedError("every branch was deleted: nothing is left")
        check_tree(refined.tree, options.quality, None if told is None else told.confidence)
        check_length(refined.tree, placed.views, options.quality)
    # Nothing but the result asks for the voxels: they are made beside what follows.
    voxels = started(lambda: refined_volume(refined, placed.views, grid, options.refine))
    with waited_for(voxels) as made:
        with watch.stage("quality", keep_if_late=True), placed.hinting():
            findings += [*placed.findings, *centers.findings]
            findings += map(Part, (*vessels.findings, *refined.findings))
            ostia = marked_places(options.ostia, [view.carm for view in placed.views])
            idle = idle_ostia(refined.tree, ostia)
            findings += map(Remark, missed + idle)
            tree = from_inlets(refined.tree, ostia)
            judged = judge(
                tree, placed.views, findings, options,
                disagreement=placed.disagreement, evidence=centers.evidence,
            )  # fmt: skip
            if judged.status == OK and kind_of(placed.views) != "exact":
                why = SecondLook(placed.views, grid, predictor, options, watch).doubt(tree)
                judged = judged if why is None else doubted(judged, tree, why)
        with watch.stage("diameters", keep_if_late=True):
            sections = measure_sections(tree, signals)
            tree = with_diameters(tree, sections)
        with watch.stage("tree", keep_if_late=True):
            volume = made()
    return Reconstruction(
        quality=judged, tree=tree, sections=sections, gaussians=refined.gaussians,
        volume=volume, grid=grid,
        angiograms=tuple(angiograms), views=placed.views, poses=placed.poses,
        seconds={**watch.seconds, "total": watch.elapsed_s},
        counts={
            "candidates": len(seen.hull), "gaussians": len(refined.gaussians.means_mm),
            "branches": len(tree.branches), "steps": refined.steps,
            "rejected_steps": refined.rejected_steps, "alternatives": len(judged.exchanges),
        },
        losses=refined.losses, predictor=centers.points.source, refiner=refined.refiner,
        model=None if predictor is None else predictor.model.label,
        segmenter=None if vessels.segmenter is None else vessels.segmenter.session.model.label,
        notes=(
            *_marks(options, len(missed), len(idle)), *thin_ostia(tree, ostia),
            *_outside(tree, grid),
        ),
        options=options, ending=refined.ending,
        close_calls=refined.close_calls,
    )  # fmt: skip


def _marks(options: RunOptions, missed: int, idle: int) -> tuple[str, ...]:
    """Say what of the result goes back to marks of the user.

    Of deletions ``missed`` did nothing, of ostia ``idle``. Lesions are said by who measures them.
    """
    counts = {
        "branches deleted": len(options.deleted_mm) - missed,
        "landmarks that hold the views to each other": len(options.landmarks),
        "marks of one vessel in several views": len(options.same_branch),
        "inlets of an artery": len(options.ostia) - idle,
    }
    return tuple(f"of the user: {what} ({n})" for what, n in counts.items() if n)


def _outside(tree: Tree, grid: Grid) -> tuple[str, ...]:
    """Say how much of the tree the volume does not hold."""
    length = 0.0
    for branch in tree.branches:
        index = grid.world2index(0.5 * (branch.points_mm[1:] + branch.points_mm[:-1]))
        out = ((index < -0.5) | (index > np.array(grid.shape) - 0.5)).any(axis=1)
        length += float(np.diff(branch.arc_mm)[out].sum())
    if length < 1.0:
        return ()
    return (f"{length:.0f} mm of the tree lie outside the volume: a larger one can be asked for",)


def _nothing(step: Step) -> None:
    """Keep no step."""
