"""Gates: whether a tree can honestly be made of these views.

A finding is a sentence that lowers the status to ``degraded``; what is worse is refused with a
``RefusedError`` before any more time is spent.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np

from gcar_deploy.config import QualityOptions
from gcar_deploy.errors import RefusedError
from gcar_deploy.geometry.carm import CArm, separation_deg
from gcar_deploy.geometry.consistency import uncovered_mm as uncovered
from gcar_deploy.geometry.consistency import vessel_mass
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.quality.along_beam import along_a_beam
from gcar_deploy.quality.duplicates import check_duplicates
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Scalars

#: exact views of which vessels are cut are believed when they ask for a shift up to this, mm
CUT_SHIFT_MM = 1.0
#: a model that is nowhere as confident as this finds no vessel, whatever the pictures show
LEAST_FOUND = 0.5
#: so much vessel that one view alone shows may be missing in the other, mm across the planes of the
#: beams. A distance that is 5 % wrong leaves up to 4, one tree half as dense 8
MISSING_MM = 10.0
#: disagreement along the epipolar lines, for those who never heard of them
NO_MATCH = "no match where the beams of both views meet"


def best_separation(carms: Sequence[CArm]) -> float:
    """Return the best angle between two views, folded to 0 .. 90 deg (opposite views see alike)."""
    pairs = (separation_deg(a, b) for a, b in itertools.combinations(carms, 2))
    return max((min(angle, 180.0 - angle) for angle in pairs), default=0.0)


def check_views(angiograms: Sequence[Angiogram], options: QualityOptions) -> list[str]:
    """Judge the directions before anything is computed.

    Returns
    -------
    findings that make the result ``degraded``

    Raises
    ------
    RefusedError
        All views look along nearly one line, or one picture was given twice.
    """
    check_duplicates(angiograms)
    angle = best_separation([angiogram.carm for angiogram in angiograms])
    if angle < options.min_separation_deg:
        raise RefusedError(
            f"views are {math.floor(100 * angle) / 100:g} deg apart (folded to 0 .. 90); at least "
            f"{options.min_separation_deg:g} deg are needed to see depth"
            + _in_radians([angiogram.carm for angiogram in angiograms], options)
        )
    findings = _frame_findings(angiograms, options)
    if angle < options.good_separation_deg:
        findings.append(
            f"views are only {angle:.1f} deg apart (folded to 0 .. 90): depth is uncertain below "
            f"{options.good_separation_deg:g} deg"
        )
    return findings


def _in_radians(carms: Sequence[CArm], options: QualityOptions) -> str:
    """Return a question where the angles, taken as radians, would set the views apart."""
    angles = np.array([(carm.primary_angle_deg, carm.secondary_angle_deg) for carm in carms])
    apart = np.degrees(np.ptp(angles, axis=0).max())
    if np.abs(angles).max() > np.pi or apart < options.min_separation_deg:
        return ""
    told = " and ".join(f"{primary:g}" for primary in angles[:2, 0])
    return f" (are the angles in radians? primary_angle_deg is {told}; degrees are asked for)"


def _frame_findings(angiograms: Sequence[Angiogram], options: QualityOptions) -> list[str]:
    """Frames of runs that may show the heart in two phases."""
    frames = [a.frame for a in angiograms if a.frame is not None and a.frame.pair is not None]
    least = min(
        (f.pair.margin for f in frames if f.pair is not None and f.pair.margin is not None),
        default=np.inf,
    )
    if least >= options.good_frame_margin:
        return []
    return [
        f"the frames may show two phases of the heart: a pair that shows another shape agrees "
        f"nearly as well (margin {least:.3f}, {options.good_frame_margin:g} is asked for); "
        "see gcar frames"
    ]


def kind_of(views: Sequence[VesselImage]) -> str:
    """Return what views that are judged together are: ``exact``, ``mask`` or, any of them, raw."""
    if all(view.calibrated for view in views):
        return "exact"
    return "mask" if all(view.calibrated or view.kind == "mask" for view in views) else "raw"


def disagreement_limits(kind: str, options: QualityOptions) -> tuple[float, float]:
    """Disagreement above which views of a kind are doubted, and above which they are refused."""
    return {
        "exact": (options.good_disagreement, options.max_disagreement),
        "mask": (options.good_disagreement_mask, options.max_disagreement_mask),
        "raw": (options.good_disagreement_raw, options.max_disagreement_raw),
    }[kind]


def check_consistency(
    views: Sequence[VesselImage],
    disagreement: Sequence[float],
    options: QualityOptions,
    partners: Sequence[int] | None = None,
) -> list[str]:
    """Judge whether the views can show one tree.

    Parameters
    ----------
    views : V vessel images
    disagreement : (V,) of each view's epipolar profile with its partner's, 0 .. 1
    partners : (V,) which view each was compared with; the first where left out

    Raises
    ------
    RefusedError
        The views contradict each other.
    """
    findings = []
    for k, (view, value) in enumerate(zip(views, disagreement, strict=True)):
        other = views[partners[k] if partners else 0]
        kind = kind_of((other, view))
        ids = other.view_id, view.view_id
        cut = [seen.view_id for seen in (other, view) if is_cut(seen)]
        refused = value > disagreement_limits(kind, options)[1]
        lone = _uncovered_mm(other, view) if refused else 0.0
        findings += check_agreement(ids, value, kind, options, cut, lone)
    return findings


def _uncovered_mm(first: VesselImage, second: VesselImage) -> float:
    """Return the length across the planes of the beams that one alone shows vessel on, mm."""
    if first is second:  # as the view that the others are compared with is
        return 0.0
    a, b = (vessel_mass(view.carm, view.path_mm) for view in (first, second))
    return 0.0 if a is None or b is None else uncovered(a, b, second.carm)


def check_agreement(
    view_ids: tuple[str, str], disagreement: float, kind: str, options: QualityOptions,
    cut: Sequence[str] = (), uncovered_mm: float = 0.0,
) -> list[str]:  # fmt: skip
    """Judge the disagreement of two views, 0 .. 1; returns and raises as ``check_consistency``.

    ``cut``: the views that vessels run out of; ``uncovered_mm``: as of ``check_asked``.
    """
    first, second = view_ids
    good, most = disagreement_limits(kind, options)
    if disagreement > most:
        why = f"vessels run out of view {cut[0]}, or " if cut else ""
        if uncovered_mm >= MISSING_MM:
            why += "vessels of one view are not filled or cut off, or "
        raise RefusedError(
            f"views {first} and {second} contradict each other: {disagreement:.0%} of the "
            f"vessels have {NO_MATCH} (at most {most:.0%}); "
            f"{why}different patients, frames, angles or pixel sizes?"
        )
    if disagreement > (min(good, options.sure_disagreement_raw) if kind == "raw" else good):
        return [
            f"view {second} agrees poorly with view {first}: {disagreement:.0%} of "
            f"the vessels have {NO_MATCH}"
        ]
    return []


def check_order(
    view_ids: tuple[str, str],
    disagreement: float,
    other_order: float | None,
    kind: str,
    options: QualityOptions,
) -> tuple[list[str], str]:
    """Judge whether two pictures could have been given in the wrong order.

    Parameters
    ----------
    view_ids : of both views
    disagreement : of the pictures as they were given, corrected, 0 .. 1
    other_order : with each other's geometry as it is told; None where they cannot be swapped
    kind : of the pictures, see ``kind_of``

    Returns
    -------
    findings : that make the result ``degraded``
    hint : what a refusal should say as well; empty where the pictures need not be swapped
    """
    good, _ = disagreement_limits(kind, options)
    # Opposite views are not compared, which leaves 0.
    if other_order is None or disagreement <= (good if kind == "exact" else 0.0):
        return [], ""
    first, second = view_ids
    instead = (
        f"with their pictures exchanged ({other_order:.0%} of the vessels differ, "
        f"not {disagreement:.0%})"
    )
    if other_order <= min(good, options.swapped_ratio * disagreement):
        hint = f"views {first} and {second} agree far better {instead}: are the pictures swapped?"
        return [hint], hint
    ratio = options.order_ratio_mask if kind == "mask" else options.order_ratio
    if other_order <= ratio * disagreement:
        return [
            f"views {first} and {second} agree about as well {instead}: the pictures do not tell "
            "whether they are swapped, or of one patient"
        ], ""
    return [], ""


def check_poses(
    views: Sequence[VesselImage],
    corrections: Sequence[tuple[Sequence[float], float]],
    options: QualityOptions,
) -> list[str]:
    """Judge the estimated corrections between the runs.

    Parameters
    ----------
    views : V vessel images
    corrections : (V,) shift (3,) in mm and larger turn in deg of each view
    """
    findings = []
    hidden = ": the same move within the plane of the beams would leave no trace"
    # Exact profiles agree to a part in a hundred, and a cut vessel takes more from one of them.
    cut = [view.view_id for view in views if view.calibrated and is_cut(view)]
    for view, (offset_mm, turn) in zip(views, corrections, strict=True):
        shift = float(np.linalg.norm(offset_mm))
        if shift > options.good_shift_mm or turn > options.good_turn_deg:
            findings.append(
                f"view {view.view_id} had to be moved by {shift:.1f} mm and turned by "
                f"{turn:.1f} deg to agree (up to {options.good_shift_mm:g} mm and "
                f"{options.good_turn_deg:g} deg are usual)"
                + along_a_beam(views, offset_mm)
                + (hidden if len(views) == 2 else "")
            )
        elif shift > CUT_SHIFT_MM and view.calibrated and cut:
            findings.append(
                f"view {view.view_id} had to be moved by {shift:.1f} mm to agree, but vessels run "
                f"out of view {cut[0]}: what is cut off there misleads the estimate"
            )
    return findings


def check_motion(
    views: Sequence[VesselImage],
    motions: Sequence[tuple[float, bool, float]],
    options: QualityOptions,
) -> list[str]:
    """Judge what the views disagree by beyond a shift, as a heart that moved makes them.

    Parameters
    ----------
    views : V vessel images
    motions : (V,) root mean square across the epipolar planes in mm (0: none was found), whether
        it is undone, and the disagreement with a rigid correction alone, 0 .. 1
    """
    findings = []
    kind = kind_of(views)
    exact = kind == "exact"
    # The width of vessels differs by a quarter between right views, too: it cannot tell.
    wider = {"mask": ", one mask is drawn thicker, or they show different patients",
             "raw": ", one picture is blurred, or they show different patients"}  # fmt: skip
    for view, (moved, undone, rigid) in zip(views, motions, strict=True):
        # What is measured leads: a wrong angle or distance looks like motion.
        told = (
            f"view {view.view_id}: beyond a shift the contours of the views disagree by "
            f"{moved:.1f} mm{'' if undone else ' or more'} (root mean square across the planes of "
            "the beams): the heart moved between the runs, or an angle or distance is a little off"
            + wider.get(kind, "")
        )
        # Masks and raw pictures show motion only where it bends the tree.
        small = exact and moved <= options.good_motion_mm and rigid <= options.good_disagreement
        if moved and undone and not small:
            findings.append(
                f"{told}; that is undone, but as much within the planes leaves no trace "
                "and bends the tree"
            )
        elif moved and not undone:
            findings.append(
                f"{told}; vessels of both pictures turn and end in other planes, which is not "
                "undone and bends the tree"
            )
    return findings


def is_cut(view: VesselImage) -> bool:
    """Whether vessels run out of a picture that holds nothing else: a path length or a mask."""
    mask = view.mask
    told = view.calibrated or view.kind == "mask"
    return told and bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())


def check_asked(
    view_ids: tuple[str, str], given: float, turn: tuple[float, float, float],
    scale: tuple[float, float, float], options: QualityOptions, uncovered_mm: float = 0.0,
) -> list[str]:  # fmt: skip
    """Judge whether the pictures ask for another angle or scale of the second view.

    Parameters
    ----------
    view_ids : of the partner and of the view
    given : disagreement of both as told, after the best shift, 0 .. 1
    turn : correction in deg, disagreement with it, and how many times more the squared difference
        is without it
    scale : the same with the factor that the view's pixels are too small by
    uncovered_mm : length across the planes of the beams that one view alone shows vessel on, mm
    """

    def significant(after: float, gain: float) -> bool:
        clearly = after <= options.asked_ratio * given and gain >= options.asked_gain
        return clearly and given - after >= options.asked_least

    by_turn = significant(*turn[1:]) and turn[0] > options.good_turn_deg
    by_scale = significant(*scale[1:]) and abs(np.log(scale[0])) > options.good_scale
    first, second = view_ids
    # Vessel that is missing at one end of a view looks like pixels that are too small.
    missing = (
        ", or are vessels of one view not filled or cut off (one alone shows vessel on "
        f"{uncovered_mm:.0f} mm across the planes of the beams)"
        if uncovered_mm >= MISSING_MM
        else ""
    )
    if by_scale and (not by_turn or scale[1] <= turn[1]):
        return [
            f"view {second} would agree better with view {first} if its pixels were "
            f"{abs(scale[0] - 1):.0%} {'larger' if scale[0] > 1 else 'smaller'} ({scale[1]:.0%} of "
            f"the vessels differ, not {given:.0%}): is its pixel spacing, SDD or SOD wrong"
            f"{missing}?"
        ]
    if by_turn:
        return [
            f"view {second} would agree better with view {first} if it were turned by "
            f"{turn[0]:.1f} deg ({turn[1]:.0%} of the vessels differ, not {given:.0%}): is an "
            f"angle of either wrong{missing}?"
        ]
    return []


def check_candidates(count: int, lattice: Grid, options: QualityOptions) -> None:
    """Refuse where hardly a point is seen as vessel by all views.

    Raises
    ------
    RefusedError
        Fewer points than a chain of cells of ``min_length_mm`` has.
    """
    cell = float(lattice.spacing_mm[0])
    if count * cell < options.min_length_mm:
        raise RefusedError(
            f"only {count} points of {cell:.2g} mm inside the volume are seen as vessel by all "
            "views; do the views show one tree, and does the volume hold it?"
        )


def check_tree(tree: Tree, options: QualityOptions, confidence: Scalars | None = None) -> None:
    """Refuse what is too little to be a coronary tree.

    Parameters
    ----------
    confidence : what a model said of all points of the hull; None where none was asked

    Raises
    ------
    RefusedError
        Less than ``min_length_mm`` of vessel.
    """
    if tree.length_mm < options.min_length_mm:
        if confidence is not None and np.max(confidence, initial=0.0) < LEAST_FOUND:
            raise RefusedError(
                "the model finds no vessel (largest confidence "
                f"{np.max(confidence, initial=0.0):.2f} of 1): do the views show one tree, "
                "or is the model trained too little?"
            )
        raise RefusedError(
            f"only {tree.length_mm:.0f} mm of vessel are seen by all views "
            f"(at least {options.min_length_mm:g} mm are needed); do the views show one tree?"
        )


@contextlib.contextmanager
def with_hint(hint: str, marks: str = "") -> Iterator[None]:
    """Let a refusal say what may be the reason: first marks of the user, at the end a hint.

    Where both are empty it stays as it is.
    """
    try:
        yield
    except RefusedError as error:
        if not (hint or marks):
            raise
        said = f"{marks} may be the reason: {error}" if marks else str(error)
        end = "" if said.endswith("?") else "."
        raise RefusedError(f"{said}{end} {hint[0].upper()}{hint[1:]}" if hint else said) from None
