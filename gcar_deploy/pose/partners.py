"""Lines of raw pictures that the other views do not show: catheters, leads, background.

Two views of one tree hold the same vessel mass in every epipolar plane. A line that one view alone
shows breaks that. So of the lines that may be no vessel (``imaging.stray_lines``) those are left
out, one after the other, without which the views agree far better. What the network takes for a
device goes already where they agree a little better; so do two of them, one in each view, since a
catheter that both show agrees as vessels do. What comes from outside is a likely one where another
view has such a device. A line that was taken for a device in one picture comes back where the views
agree far better with it. Where two views contradict each other after all that, the line goes that
is likeliest to be no vessel by all that is known of it (``odds``).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeAlias

import numpy as np

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.stray_lines import (
    INSIDE,
    comes_from_outside,
    likely_devices,
    lost_lines,
    shows_device,
    stray_lines,
    with_line,
)
from gcar_deploy.pose.odds import left_out, lines_of, without_likeliest
from gcar_deploy.pose.pairwise import Pose, worst_of
from gcar_deploy.types import Mask

#: what is changed of what the pictures show lowers the disagreement to this share at least
GAIN = 0.85
#: what was taken for a device comes back where it does so much, though the views agree already. Of
#: 119 lines of devices in generated cath-lab pairs (seeds 7900 and 9100) none lowers it to less
#: than 0.84; of 31 true branches that were taken away 25 lower it to less than this when put back
BACK_GAIN = 0.75
#: what is so probably a device, or comes from outside as a device in another view does, goes where
#: the views agree a little better without it
LIKELY, LIKELY_GAIN = 0.5, 0.95
#: at least this share of a view's line stays
KEPT_SHARE = 0.5
#: of a view's lines the longest are asked
MOST_LINES = 8
#: three and more views are fitted together, which takes a second: of what could change those ways
#: are fitted, so many a round, with which the views agree best where they stand
MOST_FITTED = 4
#: two lines at once are asked of no more views: of eight with eight lines each that would be 1,792
#: ways a round, each judged in all 28 pairs of views
MOST_TWO_OF = 4
#: pictures full of lines that no other view shows are asked no further: fits of one scene, in whole
#: rounds. Of twelve generated cath-lab pairs (seed 91101) the one that gained most took 201
MOST_WAYS = 400
Views: TypeAlias = "Sequence[VesselImage]"


def partnered(
    views: Sequence[VesselImage], poses: tuple[Pose, ...], asked: Sequence[bool], enough: float,
    contradict: float,
    estimate: Callable[[Views], tuple[Pose, ...]],
    judge: Callable[[Views, tuple[Pose, ...]], tuple[Pose, ...]],
) -> tuple[list[VesselImage], tuple[Pose, ...]]:  # fmt: skip
    """Leave out likely devices, and lines that no other view shows until the views agree enough.

    Lines that were taken for devices come back where the views agree far better with them.

    Parameters
    ----------
    views : V vessel images
    poses : what ``estimate`` says of them
    asked : of each view whether its lines may be left out
    enough : disagreement, 0 .. 1, from which on a line has to be a likely device to go, and to
        change more to come back
    contradict : disagreement from which on two views contradict each other
    estimate : poses of such views
    judge : poses of such views as they are, with what the views say of them

    Returns
    -------
    views, poses : those that are not changed are the same objects
    """
    now = list(views)
    least = [KEPT_SHARE * view.skeleton.sum() for view in views]
    # Few views change from round to round.
    fewer_of, more_of = functools.cache(_fewer), functools.cache(_more)
    has_device, every_line = functools.cache(shows_device), functools.cache(lines_of)
    gone = [np.zeros_like(view.mask) for view in views]
    ways = 0
    while ways < MOST_WAYS:
        left = worst_of(poses)
        devices = [has_device(view) for view in now]
        fewer = [
            fewer_of(view, few, any(devices[:k] + devices[k + 1 :])) if may else ()
            for k, (view, few, may) in enumerate(zip(now, least, asked, strict=True))
        ]
        likely = [[one for one, device in some if device] for some in fewer]
        tried = [(each, LIKELY_GAIN) for each in _one_of(now, likely)]
        if len(now) <= MOST_TWO_OF:
            tried += [(each, LIKELY_GAIN) for each in _two_of(now, likely)]
        if left > enough:
            others = [[one for one, device in some if not device] for some in fewer]
            tried += [(each, GAIN) for each in _one_of(now, others)]
        gain = GAIN if left > enough else BACK_GAIN
        # What went by its odds stays away, or it would come and go for ever.
        lost = [
            [one for one in more_of(view) if not _mostly(one[0].mask & ~view.mask, out)]
            if may
            else ()
            for view, may, out in zip(now, asked, gone, strict=True)
        ]
        tried += [(each, gain) for each in _one_of(now, _back(lost))]
        if len(now) > 2:
            tried.sort(key=lambda one: worst_of(judge(one[0], poses)) / one[1])
            del tried[MOST_FITTED:]
        ways += len(tried)
        fitted = [estimate(each) for each, _ in tried]
        after = [worst_of(some) / gain for some, (_, gain) in zip(fitted, tried, strict=True)]
        better = [k for k, left_then in enumerate(after) if left_then <= left]
        if better:
            # Who shows less disagrees about less.
            of_each = zip(*(way for way, _ in tried), strict=True)
            fullest = [max(same, key=_length) for same in of_each]
            best = min(better, key=lambda k: after[k] / shown_share(tried[k][0], fullest))
            now, poses = tried[best][0], fitted[best]
            continue
        if len(now) > 2 or left <= contradict:
            break
        closer = without_likeliest(now, poses, asked, least, devices, every_line, estimate)
        if closer is None:
            break
        gone = [
            out | (view.mask & ~fewer.mask)
            for out, view, fewer in zip(gone, now, closer[0], strict=True)
        ]
        now, poses = closer
    return now, poses


def shown_share(views: Views, fuller: Views) -> float:
    """Share of the lines of fuller views that are shown, 0 .. 1, of the view that lacks most."""
    return min(
        1.0,
        *(_length(one) / max(_length(full), 1.0) for one, full in zip(views, fuller, strict=True)),
    )


def _length(view: VesselImage) -> float:
    return float(view.skeleton.sum())


def _mostly(part: Mask, whole: Mask) -> bool:
    """Whether most of a part lies in the whole."""
    return bool(2 * np.count_nonzero(part & whole) > np.count_nonzero(part))


def _one_of(views: Views, instead: Sequence[Views]) -> Iterator[list[VesselImage]]:
    """Yield the views with one replaced, for each that may stand ``instead`` of it."""
    for k, some in enumerate(instead):
        for one in some:
            yield [*views[:k], one, *views[k + 1 :]]


def _two_of(views: Views, instead: Sequence[Views]) -> Iterator[list[VesselImage]]:
    """Yield the views with two of them replaced: what both show agrees as vessels do."""
    for first in range(len(views)):
        for once in _one_of(views, [s if k == first else () for k, s in enumerate(instead)]):
            yield from _one_of(once, [s if k > first else () for k, s in enumerate(instead)])


def _fewer(view: VesselImage, least_px: float, elsewhere: bool) -> list[tuple[VesselImage, bool]]:
    """Return the view without one of its lines, and if that is a likely device, for each.

    A line from outside is a likely one where another view has a device from outside ``elsewhere``.
    """
    lines = _longest(stray_lines(view))
    lines += list(likely_devices(view, INSIDE))
    return [
        (line.left, (elsewhere and line.outside) or line.said >= LIKELY)
        for line in left_out(view, lines)
        if line.left.skeleton.sum() >= least_px
    ]


def _more(view: VesselImage) -> list[tuple[VesselImage, bool]]:
    """Return the view with a line that was taken for a device, for each, and if from outside."""
    if view.kept is None:
        return []
    whole = view.kept()
    return [
        (with_line(view, whole, line), comes_from_outside(view, line))
        for line in _longest(lost_lines(view, whole))
    ]


def _back(lost: Sequence[Sequence[tuple[VesselImage, bool]]]) -> list[list[VesselImage]]:
    """Return for each view what it may be with a line that was taken for a device.

    What comes from outside in two views is a catheter, which both show.
    """
    outside = [any(comes for _, comes in some) for some in lost]
    return [
        [one for one, comes in some if not (comes and any(outside[:k] + outside[k + 1 :]))]
        for k, some in enumerate(lost)
    ]


def _longest(lines: Iterable[Mask]) -> list[Mask]:
    return sorted(lines, key=lambda line: -int(line.sum()))[:MOST_LINES]
