"""Status: how far to trust a finished tree, by what the pictures say of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.config import QualityOptions, RunOptions
from gcar_deploy.errors import GeometryError, RefusedError
from gcar_deploy.geometry.carm import CArm, separation_deg
from gcar_deploy.geometry.consistency import match_rate
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.extract import PATH_THRESHOLD_PIXELS
from gcar_deploy.measure.lumen import hidden_share
from gcar_deploy.predict import Evidence
from gcar_deploy.quality import alternatives
from gcar_deploy.quality.anatomy import check_anatomy
from gcar_deploy.quality.border import check_border
from gcar_deploy.quality.gates import (
    NO_MATCH,
    best_separation,
    disagreement_limits,
    is_cut,
    kind_of,
)
from gcar_deploy.quality.ghosts import Ghosts, check_ghosts, find_ghosts
from gcar_deploy.quality.gravity import Part, Remark, gravest_first
from gcar_deploy.quality.hidden_ends import check_hidden_ends
from gcar_deploy.quality.human_range import check_human_range
from gcar_deploy.quality.missing import check_missing
from gcar_deploy.quality.scale import check_scale
from gcar_deploy.quality.severed import check_severed
from gcar_deploy.quality.shown import Shown
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes import Footprint
from gcar_deploy.types import Array, Mask, Scalars

OK, DEGRADED, REFUSED = "ok", "degraded", "refused"
#: what ``ok`` rests on, of two views and of more, and what no result of few views can rest on
_CHECKED = (
    "Checked: agreement and order of the views, what they show of the tree and it of them, its size"
)
_OF_TWO = ", exchangeable vessels and probable ghosts."
_OF_MORE = ". Exchangeable vessels and probable ghosts are looked for in two views alone."
_UNSEEN = (
    "Views cannot check a shift or turn within the plane of their beams, nor vessel that no "
    "picture shows."
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewQuality:
    """How well the reprojected tree and one picture agree.

    Attributes
    ----------
    view_id : str
    name : str, clinical words, for instance ``'RAO 30 CAU 20'``
    coverage : share of what the picture shows of vessel (its skeleton, each pixel by its path
        length: thin ends count less) near the reprojected centreline
    support : share of the reprojected centreline (inside the picture) near the vessel mask; not
        its skeleton, which runs between two vessels that lie side by side
    distance_mm : mean distance of the skeleton from the centreline, at the isocentre
    overlap : Dice coefficient of vessel mask and reprojected lumen
    coverage_2px : as ``coverage``, but within 2 pixels of the picture, whatever their size
    match_rate : share of the skeleton with a possible partner in the view that sees best across
    foreshortening : share of the tree's length that this view loses by looking along it
    coverage_even : as ``coverage``, with every pixel of the skeleton counted alike
    left_out : share of what looks like vessel that was taken for a catheter or has no partner

    Undefined figures are None (no skeleton, or no tree in the picture).
    """

    view_id: str
    name: str
    coverage: float | None
    support: float | None
    distance_mm: float | None
    overlap: float | None
    coverage_2px: float | None = None
    match_rate: float | None = None
    foreshortening: float | None = None
    coverage_even: float | None = None
    left_out: float = 0.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Quality:
    """Status with a sentence, and what led to it.

    Attributes
    ----------
    status : ``ok`` or ``degraded`` (``refused`` and ``failed`` are raised as errors)
    sentence : str
    findings : every reason for ``degraded``, the gravest first
    separation_deg : best angle between two views, folded to 0 .. 90
    disagreement : worst epipolar disagreement of any view with its partner (``worst_of``), or None
    views : one ViewQuality per view
    exchanges : vessels that the pictures would let change partners
    ghosts : what is known of ghosts in the tree; None where nothing is
    """

    status: str
    sentence: str
    findings: tuple[str, ...]
    separation_deg: float
    disagreement: float | None
    views: tuple[ViewQuality, ...]
    exchanges: tuple[alternatives.Exchange, ...] = ()
    ghosts: Ghosts | None = None


def judge(
    tree: Tree,
    views: Sequence[VesselImage],
    findings: Sequence[str],
    options: RunOptions,
    *,
    disagreement: float,
    evidence: Evidence | None,
) -> Quality:
    """Say of a finished tree what it leaves open, and judge it against the pictures.

    Parameters
    ----------
    tree : Tree
    views : the pictures that it was made from, with the geometry that it was made with
    findings : earlier reasons for ``degraded``
    options : RunOptions
    disagreement : worst epipolar disagreement, 0 .. 1
    evidence : what the predictor of all views said, or None

    Raises
    ------
    RefusedError
        As ``assess`` and ``check_scale``.
    """
    masks = kind_of(views) == "mask"
    open_ = alternatives.exchanges(tree, [view.carm for view in views], masks=masks)
    shown = Shown(tree, views, evidence)
    elsewhere = alternatives.evidence_elsewhere(shown)
    ghosts = find_ghosts(shown)
    whole = [
        *check_scale(tree, views), *check_human_range(tree),
        *check_anatomy(tree, [view.carm for view in views]),
    ]  # fmt: skip
    parts = [
        *alternatives.findings(open_, elsewhere), *check_ghosts(ghosts, options.quality),
        *check_severed(tree, views), *check_hidden_ends(tree, views),
        *check_missing(tree, views),
    ]  # fmt: skip
    findings = [*findings, *whole, *map(Part, parts), *map(Remark, check_border(tree, views))]
    lumen = [_lumen(seen, v.carm) for seen, v in zip(shown.prints, views, strict=True)]
    judged = assess(tree, views, lumen, findings, disagreement, options.quality)
    return dataclasses.replace(judged, exchanges=open_, ghosts=ghosts)


def _lumen(seen: Footprint, carm: CArm) -> Mask:
    """(rows, cols) bool: where the rays cross as much of the tree as counts as vessel."""
    path = seen.image((carm.rows, carm.columns))
    inside: Mask = path > PATH_THRESHOLD_PIXELS * carm.pixel_at_isocenter_mm
    return inside


def assess(
    tree: Tree,
    views: Sequence[VesselImage],
    lumen: Sequence[Mask],
    findings: Sequence[str],
    disagreement: float | None,
    options: QualityOptions,
) -> Quality:
    """Judge the finished tree against the pictures.

    Parameters
    ----------
    tree : Tree
    views : the pictures that it was made from, with the geometry that it was made with
    lumen : per view (rows, cols) bool, where the reprojected lumen falls
    findings : earlier reasons for ``degraded``
    disagreement : worst epipolar disagreement, None if it was not measured

    Raises
    ------
    RefusedError
        Hardly anything of a view is explained, or hardly anything of the tree is seen.
    """
    judged = [
        view_quality(tree, view, inside, options, _across(view, views))
        for view, inside in zip(views, lumen, strict=True)
    ]
    cut = [view.view_id for view in views if is_cut(view)]
    explained = check_explained(judged, disagreement, kind_of(views), options, cut)
    findings = gravest_first([*findings, *map(Part, explained)])
    return Quality(
        status=DEGRADED if findings else OK,
        sentence=_sentence(findings, tree, len(views)),
        findings=findings,
        separation_deg=best_separation([view.carm for view in views]),
        disagreement=disagreement,
        views=tuple(judged),
    )


def check_explained(
    views: Sequence[ViewQuality],
    disagreement: float | None,
    kind: str,
    options: QualityOptions,
    cut: Sequence[str] = (),
) -> list[str]:
    """Judge how much of the pictures a tree explains, and how much of it they show.

    Parameters
    ----------
    views : what the comparison of each picture with the tree gave
    disagreement : worst epipolar disagreement, None if it was not measured
    kind : of the pictures, see ``kind_of``
    cut : views that vessels run out of; what is cut off there is in no tree

    Raises
    ------
    RefusedError
        As for ``assess``.
    """
    findings = []
    doubtful = (disagreement or 0.0) > disagreement_limits(kind, options)[0]
    several = len(views) > 2 and kind != "exact"
    enough = options.enough_coverage if several else options.good_coverage
    even = {one.view_id: one.coverage_even or 0.0 for one in views}
    # A tree of all that such a view shows leaves lines of the others unexplained.
    whole = {name for name in cut if even[name] >= options.good_coverage}
    for one in views:
        # A tree of two patients misses thin vessels first.
        if doubtful and even[one.view_id] < enough:
            if not whole:
                raise RefusedError(
                    f"the views contradict each other: {disagreement:.0%} of the vessels have "
                    f"{NO_MATCH}, and no tree explains more than "
                    f"{even[one.view_id]:.0%} of the lines in view {one.view_id}; "
                    "different patients, frames, angles or pixel sizes?"
                )
            findings.append(
                f"view {one.view_id}: only {even[one.view_id]:.0%} of the lines are explained; "
                f"vessels run out of view {min(whole)}, and what is cut off there "
                "is in no tree"
            )
        for value, least, good, what in (
            (one.coverage, options.min_coverage, options.good_coverage,
             "of the vessels seen, weighed by thickness, is explained by the tree"),
            (one.support, options.min_support, options.good_support,
             "of the tree lies on the picture's vessels"),
        ):  # fmt: skip
            share = 0.0 if value is None else value
            if share < least:
                raise RefusedError(f"view {one.view_id}: only {share:.0%} {what}")
            if share < good:
                findings.append(f"view {one.view_id}: only {share:.0%} {what}")
    return findings


def doubted(judged: Quality, tree: Tree, finding: str) -> Quality:
    """Return a judgement with one more reason for ``degraded``."""
    findings = gravest_first([*judged.findings, Part(finding)])
    sentence = _sentence(findings, tree, len(judged.views))
    return dataclasses.replace(judged, status=DEGRADED, sentence=sentence, findings=findings)


def _sentence(findings: Sequence[str], tree: Tree, count: int) -> str:
    if not findings:
        checked = _CHECKED + (_OF_TWO if count == 2 else _OF_MORE)
        return f"All {count} views are explained by {_pieces(tree)}. {checked} {_UNSEEN}"
    more = f" (and {len(findings) - 1} more)" if len(findings) > 1 else ""
    text = findings[0][0].upper() + findings[0][1:] + more
    return text if text.endswith("?") else f"{text}."


def _pieces(tree: Tree) -> str:
    """Name one tree, or the separate pieces of one that does not hang together."""
    *others, last = (f"{length:.0f}" for length in part_lengths_mm(tree) or (0.0,))
    if not others:
        return "one tree"
    return f"{len(others) + 1} separate pieces of {', '.join(others)} and {last} mm"


def part_lengths_mm(tree: Tree) -> tuple[float, ...]:
    """Vessel length in each connected part of a tree, the longest first, mm."""
    lengths = tree.part_lengths_mm()
    return tuple(sorted(lengths[lengths > 0].tolist(), reverse=True))


def _across(view: VesselImage, views: Sequence[VesselImage]) -> VesselImage | None:
    """Return the other view whose direction is nearest to 90 deg from this one's."""
    others = [other for other in views if other is not view]
    return min(others, key=lambda v: abs(separation_deg(view.carm, v.carm) - 90.0), default=None)


def view_quality(
    tree: Tree,
    view: VesselImage,
    lumen: Mask,
    options: QualityOptions,
    partner: VesselImage | None = None,
) -> ViewQuality:
    """Compare one picture with the reprojected tree; see ``ViewQuality``."""
    pixel_mm = view.carm.pixel_at_isocenter_mm
    near_px = _near_px(view.carm, options)
    line = centreline_mask(tree, view.carm)
    seen = view.skeleton & view.valid
    coverage = support = distance = strict = even = None
    if seen.any() and line.any():
        gap = _distance_to(line)[seen]
        weight = view.path_mm[seen].astype(np.float64)
        weight = weight / weight.sum() if weight.any() else np.full(len(gap), 1 / len(gap))
        # Weights that sum to 1 but for the last digit do not make a share above it.
        coverage = min(float(weight @ (gap <= near_px)), 1.0)
        even = float((gap <= near_px).mean())
        distance = float(gap.mean() * pixel_mm)
        strict = min(float(weight @ (gap <= 2.0)), 1.0)
        visible = line & view.valid
        if visible.any():
            support = float((_distance_to(view.mask)[visible] <= near_px).mean())
    total = int(lumen.sum()) + int(view.mask.sum())
    return ViewQuality(
        view_id=view.view_id,
        name=view.carm.clinical_name(),
        coverage=coverage,
        support=support,
        distance_mm=distance,
        overlap=2.0 * int((lumen & view.mask).sum()) / total if total else None,
        coverage_2px=strict,
        match_rate=None if partner is None else _match_rate(view, partner),
        foreshortening=hidden_share(tree, view.carm),
        coverage_even=even,
        left_out=_left_out(view),
    )


def _left_out(view: VesselImage) -> float:
    if view.catheter is None:
        return 0.0
    alone = int((view.catheter & ~view.mask).sum())
    return alone / max(1, alone + int(view.mask.sum()))


def _match_rate(view: VesselImage, partner: VesselImage) -> float | None:
    a, b = (np.argwhere(v.skeleton & v.valid)[:, ::-1].astype(np.float64) for v in (view, partner))
    near_mm = 2.0 * max(view.carm.pixel_at_isocenter_mm, partner.carm.pixel_at_isocenter_mm)
    try:
        return match_rate(view.carm, partner.carm, a, b, near_mm)
    except GeometryError:  # exactly opposite: no epipolar planes
        return None


def unexplained(tree: Tree, view: VesselImage, options: QualityOptions) -> Mask:
    """(rows, cols) bool: pixels of the picture's skeleton that lower its ``coverage``."""
    seen: Mask = view.skeleton & view.valid
    line = centreline_mask(tree, view.carm)
    return seen & (_distance_to(line) > _near_px(view.carm, options)) if line.any() else seen


def _near_px(carm: CArm, options: QualityOptions) -> float:
    return max(options.near_px, options.near_mm / carm.pixel_at_isocenter_mm)


def centreline_mask(tree: Tree, carm: CArm) -> Mask:
    """(rows, cols) bool: pixels that the reprojected centreline passes through."""
    canvas = np.zeros((carm.rows, carm.columns), np.uint8)
    for branch in tree.branches:
        pixels, depth = carm.project(branch.points_mm)
        pixels = np.clip(pixels[depth > 1.0], -8192, 8192)
        if len(pixels) > 1:
            cv2.polylines(canvas, [np.rint(pixels * 16).astype(np.int32)], False, 1, 1, 8, 4)
    out: Mask = canvas.astype(bool)
    return out


def _distance_to(mask: Mask) -> Array | Scalars:
    """(rows, cols) distance to the nearest true pixel, pixels."""
    distance: Array = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    return distance
