"""Agreement of the views along the epipolar lines: as told, moved, in parts, in the other order."""

from __future__ import annotations

import dataclasses
import itertools
import logging
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from gcar_deploy.config import PoseOptions, RunOptions
from gcar_deploy.geometry.consistency import (
    Mass,
    chequered,
    disagreement,
    mass_profiles,
    vessel_mass,
)
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.resample import coarsened, sampled_path
from gcar_deploy.imaging.widths import by_width, others_too, own_widths
from gcar_deploy.pose.frontier import by_frontiers
from gcar_deploy.pose.landmarks import landmark_pixels
from gcar_deploy.pose.motion import estimate_motion, still
from gcar_deploy.pose.pairwise import Pose, estimate_poses, judged_poses, worst_of
from gcar_deploy.pose.partners import GAIN, partnered, shown_share
from gcar_deploy.quality import Remark, check_order, disagreement_limits, kind_of
from gcar_deploy.types import Image

_log = logging.getLogger(__name__)
#: poses of readings of the views, after a look whether there is still time
Estimate: TypeAlias = Callable[[Sequence[VesselImage]], tuple[Pose, ...]]

#: readings of two views, of those that agree best as they stand, whose correction is estimated
READINGS = 4
#: of the further readings of a view the first are what each method sees
METHODS = 2
#: less than this share of a view's vessels may go unsaid: a pixel or two of an edge
LEAST_SAID = 0.01


def agreeing(
    angiograms: Sequence[Angiogram],
    views: Sequence[VesselImage],
    options: RunOptions,
    check: Callable[[], None] | None = None,
) -> tuple[list[VesselImage], tuple[Pose, ...], list[str]]:
    """Estimate poses; where raw pictures disagree, from less of each if that agrees better.

    First with a word of the widths about path lengths, if that agrees far better; then from what
    one method sees of all views, where the other followed lines that have no counterpart; then
    without lines that no other view shows, and with those that were taken for devices and that
    another view shows (``partners``). Where they contradict each other still, the same from any
    reading of either view, and then from widths alone. Nothing of a mask that the user gave is left
    out. ``check`` is called before each estimate, and may raise.

    Returns
    -------
    views : as given, or a reading of them, or without some of their lines
    poses : one per view
    findings : that lines were left out or came back, or depth is told by widths: the result is
        ``degraded``
    """
    asked = [
        not (view.calibrated or view.kind == "mask" or angiogram.mask is not None)
        for angiogram, view in zip(angiograms, views, strict=True)
    ]
    limits = options.quality

    def estimate(tried: Sequence[VesselImage]) -> tuple[Pose, ...]:
        if check is not None:
            check()
        return poses_between(tried, options)

    def judge(tried: Sequence[VesselImage], placed: Sequence[Pose]) -> tuple[Pose, ...]:
        return poses_between(tried, options, placed)

    views, first = _with_widths(views, asked, estimate(views), estimate)
    seen, poses = views, first
    for readings in (_by_method, _likeliest):
        tried = seen
        seen, poses = _closest(tried, poses, readings(views, first, options), options,
                               estimate)  # fmt: skip
        if seen is tried and readings is _likeliest:
            break
        fewer, closer = partnered(
            seen, poses, asked, limits.parts_disagreement_raw, limits.good_disagreement_raw,
            estimate, judge,
        )  # fmt: skip
        if worst_of(closer) <= limits.good_disagreement_raw:
            return fewer, closer, _changed(fewer, seen)
    # What still contradicts is another tree: it is not trimmed to fit.
    return _by_width(views, asked, options, estimate) or (list(seen), poses, [])


def _with_widths(
    views: Sequence[VesselImage], asked: Sequence[bool], poses: tuple[Pose, ...],
    estimate: Estimate,
) -> tuple[Sequence[VesselImage], tuple[Pose, ...]]:  # fmt: skip
    """Let widths have a word about the paths of raw pictures where the views agree far better so.

    Where contrasts are clean, widths make paths worse.
    """
    own = [own_widths(view) if may else view for view, may in zip(views, asked, strict=True)]
    if all(one is view for one, view in zip(own, views, strict=True)):
        return views, poses
    closer = estimate(own)
    if worst_of(closer) >= GAIN * worst_of(poses):
        return views, poses
    _log.info("the views agree far better where widths have a word about path lengths")
    return [others_too(view) if may else view for view, may in zip(own, asked, strict=True)], closer


def _changed(now: Sequence[VesselImage], views: Sequence[VesselImage]) -> list[str]:
    """Say what was left out of the views, and what came back that was taken for a device."""
    said = []
    for one, view in zip(now, views, strict=True):
        less, more = (view.mask & ~one.mask).sum(), (one.mask & ~view.mask).sum()
        if less >= LEAST_SAID * view.mask.sum() > 0:
            said.append(
                f"view {one.view_id}: {less / view.mask.sum():.0%} of what looks like vessel has "
                "no counterpart in the other views: left out as catheter, lead or background"
            )
        if more >= LEAST_SAID * one.mask.sum() > 0:
            said.append(
                f"view {one.view_id}: {more / one.mask.sum():.0%} of the vessels look like a "
                "catheter or lead; they are kept, because the other views show them as well"
            )
    return [Remark(text) for text in said]


def _by_width(
    views: Sequence[VesselImage], asked: Sequence[bool], options: RunOptions, estimate: Estimate
) -> tuple[list[VesselImage], tuple[Pose, ...], list[str]] | None:
    """Take depth from widths where contrasts contradict each other; None where widths do too.

    Contrast fails where a display cuts off the darkest grey values, and in front of what is as
    dark as a vessel; the outlines may be right all the same.
    """
    if not any(asked):
        return None
    drawn = [by_width(view) if may else view for view, may in zip(views, asked, strict=True)]
    poses = estimate(drawn)
    if worst_of(poses) > options.quality.good_disagreement_mask:
        return None
    ids = " and ".join(view.view_id for view, may in zip(views, asked, strict=True) if may)
    said = f"view {ids}: contrasts contradict each other; depth is taken from the widths of vessels"
    return drawn, poses, [said]


def _closest(
    views: Sequence[VesselImage], poses: tuple[Pose, ...],
    readings: Sequence[Sequence[VesselImage]], options: RunOptions, estimate: Estimate,
) -> tuple[Sequence[VesselImage], tuple[Pose, ...]]:  # fmt: skip
    """Take the first reading that agrees far better than all before it, if any.

    Who shows less disagrees about less: the disagreement counts by the share of lines that is left.
    """
    limits, worst = options.quality, worst_of(poses)
    if worst <= limits.alone_disagreement_raw:
        return views, poses
    whole = views
    for read in readings:
        closer = estimate(read)
        after, kept = worst_of(closer), shown_share(read, whole)
        if limits.alone_ratio * after < kept * worst:
            _log.info("the views agree better by what one method sees of them, or without rims")
            views, poses, worst = read, closer, after / kept
    return views, poses


def _by_method(
    views: Sequence[VesselImage], poses: Sequence[Pose], options: RunOptions
) -> list[list[VesselImage]]:
    """Return what the network sees of all views, and what the classical method does."""
    most = min(METHODS, max(len(view.others) for view in views))
    return [
        [view.others[k] if k < len(view.others) else view for view in views] for k in range(most)
    ]


def _likeliest(
    views: Sequence[VesselImage], poses: Sequence[Pose], options: RunOptions
) -> list[list[VesselImage]]:
    """Return the readings of two views that agree best where these stand now."""
    readings = [(view, *view.others) for view in views]
    if len(views) != 2 or max(map(len, readings)) == 1:
        return []
    masses = [profiled(own, options)[0] for own in readings]
    fine_mm = _smoothing(views, options).fine_mm

    def apart(pair: tuple[int, ...]) -> float:
        fixed, moving = masses[0][pair[0]], masses[1][pair[1]]
        if fixed is None or moving is None:
            return 1.0
        return disagreement(fixed, moving, poses[1].applied(moving.carm), fine_mm)

    pairs = itertools.product(*(range(len(own)) for own in readings))
    order = sorted(pairs, key=apart)[:READINGS]
    return [[own[k] for own, k in zip(readings, pair, strict=True)] for pair in order]


def poses_between(
    views: Sequence[VesselImage], options: RunOptions, known: Sequence[Pose] | None = None
) -> tuple[Pose, ...]:
    """Estimate the correction of every view against the first from their vessel profiles.

    With ``known`` corrections nothing is estimated, only what the profiles say of them.
    """
    calibrated, pose = [view.calibrated for view in views], _smoothing(views, options)
    small = [sampled_path(v, options.predict.min_cell_mm) for v in views]
    marks = landmark_pixels(options.landmarks, [view.carm for view in views])
    for k, (view, (carm, _)) in enumerate(zip(views, small, strict=True)):
        scale = np.array(carm.focal_px) / view.carm.focal_px
        old, new = np.array(view.carm.principal_point), np.array(carm.principal_point)
        marks[:, k] = (marks[:, k] - old) * scale + new
    if known is not None:
        return judged_poses(known, small, pose, marks, calibrated)
    masks = [view.kind == "mask" for view in views]
    return estimate_poses(small, pose, marks, calibrated, masks, _grains(views, options))


def _grains(views: Sequence[VesselImage], options: RunOptions) -> list[Image | None]:
    """Return the grain of calibrated views, with the pixels of ``sampled_path``."""
    cell = options.predict.min_cell_mm
    return [
        coarsened(v.carm, (chequered(v.path_mm),), cell / v.carm.pixel_at_isocenter_mm)[1][0]
        if v.calibrated else None
        for v in views
    ]  # fmt: skip


def profiled(
    views: Sequence[VesselImage], options: RunOptions
) -> tuple[list[Mass | None], PoseOptions]:
    """Vessel mass of every view as poses are estimated from it, and how it is to be smoothed."""
    small = [sampled_path(v, options.predict.min_cell_mm) for v in views]
    masses = [
        vessel_mass(carm, path, v.calibrated, v.kind == "mask")
        for (carm, path), v in zip(small, views, strict=True)
    ]
    return masses, _smoothing(views, options)


def with_motion(
    views: Sequence[VesselImage], poses: Sequence[Pose], options: RunOptions
) -> tuple[Pose, ...]:
    """Return the poses of two views with the motion of the heart between them, if any.

    Where there is some, the correction is estimated anew together with it: from the mass profiles
    of exact pictures (``motion``), from the frontier points of others (``frontier``).
    """
    if len(views) != 2 or not options.pose.enabled or poses[1].partner:
        return tuple(poses)
    exact = all(view.calibrated for view in views)
    if exact and poses[1].after <= still(max(view.carm.pixel_at_isocenter_mm for view in views)):
        return tuple(poses)
    masses, smoothing = profiled(views, options)
    fixed, moving = masses
    if fixed is None or moving is None:
        return tuple(poses)
    if not exact:
        found = by_frontiers(views, poses[1], bool(options.landmarks))
        if found.motion is None and found.theta is poses[1].theta:
            return poses[0], found
        moved = moving if found.motion is None else dataclasses.replace(
            moving, pixels=moving.pixels + found.motion.at(moving.carm, moving.pixels)
        )  # fmt: skip
        after = disagreement(fixed, moved, found.applied(moving.carm), smoothing.fine_mm)
        return poses[0], dataclasses.replace(found, after=after)
    estimate = estimate_motion(fixed, moving, poses[1].theta, smoothing)
    if estimate is None:
        return tuple(poses)
    theta, motion, after = estimate
    return poses[0], dataclasses.replace(poses[1].at(theta), after=after, motion=motion)


def _smoothing(views: Sequence[VesselImage], options: RunOptions) -> PoseOptions:
    # Profiles finer than a pixel are sampling noise, which calibrated ones would be judged by.
    pixel = max(view.carm.pixel_at_isocenter_mm for view in views)
    exact = all(view.calibrated for view in views)
    finest = max(pixel, options.predict.min_cell_mm) if exact else 0.75 * pixel
    return dataclasses.replace(
        options.pose,
        fine_mm=max(options.pose.fine_mm, finest),
        coarse_mm=max(options.pose.coarse_mm, 1.5 * pixel),
    )


def other_order(views: Sequence[VesselImage], options: RunOptions) -> float | None:
    """Compare views of which two pictures change places, without any correction.

    Returns
    -------
    least disagreement of any two pictures with each other's geometry as it is told (of the worst
    pair, where there are more views), 0 .. 1; None where all pictures' sizes differ: these cannot
    have been swapped
    """
    found = _other_orders(views, options)
    return min(found.values(), default=None)


def _other_orders(
    views: Sequence[VesselImage], options: RunOptions
) -> dict[tuple[int, int], float]:
    """Worst disagreement for each two pictures that could have changed places."""
    asked = dataclasses.replace(
        options, pose=dataclasses.replace(options.pose, enabled=False), landmarks=()
    )
    out = {}
    for i, j in itertools.combinations(range(len(views)), 2):
        if views[i].mask.shape == views[j].mask.shape:
            swapped = list(views)
            swapped[i] = dataclasses.replace(views[i], carm=views[j].carm)
            swapped[j] = dataclasses.replace(views[j], carm=views[i].carm)
            out[i, j] = worst_of(poses_between(swapped, asked))
    return out


def order_of(
    views: Sequence[VesselImage], poses: Sequence[Pose], options: RunOptions
) -> tuple[list[str], str]:
    """Judge whether two of the pictures may be swapped; see ``check_order``."""
    calibrated = all(view.calibrated for view in views)
    given = worst_of(poses)
    # More views that agree leave no room for another order, and no time is spent on it.
    if (calibrated or len(views) > 2) and given <= _agreed(views, options):
        return [], ""
    orders = _other_orders(views, options)
    if not orders:
        return [], ""
    i, j = min(orders, key=lambda pair: orders[pair])
    ids = views[i].view_id, views[j].view_id
    return check_order(ids, given, orders[i, j], kind_of(views), options.quality)


def scale_hint(views: Sequence[VesselImage], poses: Sequence[Pose], options: RunOptions) -> str:
    """Say where two views contradict each other by the scale of their path lengths alone.

    With the geometry as it is told, their paths then add up to different sums, but to the same in
    every epipolar plane but for that factor; empty of others, and of views that agree.
    """
    good, most = disagreement_limits(kind_of(views), options.quality)
    if len(views) != 2 or kind_of(views) != "exact" or worst_of(poses) <= most:
        return ""
    (fixed, moving), smoothing = profiled(views, options)
    if fixed is None or moving is None:
        return ""
    a, b = mass_profiles(fixed, moving, moving.carm, smoothing.fine_mm)
    ratio = float(b.sum() / a.sum())
    if 0.5 * np.abs(a / a.sum() - b / b.sum()).sum() > good:
        return ""
    first, second = views[0].view_id, views[1].view_id
    return (
        f"the paths of view {second} add up to {ratio:.2g} times those of view {first}, and are "
        "alike but for that: is mm_per_count right of both?"
    )


def _agreed(views: Sequence[VesselImage], options: RunOptions) -> float:
    """Disagreement up to which nobody asks whether pictures are swapped."""
    kind = kind_of(views)
    good = disagreement_limits(kind, options.quality)[0]
    return good if kind == "exact" else min(good, options.quality.alone_disagreement_raw)
