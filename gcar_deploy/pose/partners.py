"""Lines of raw pictures that the other views do not show: catheters, leads, background.

Two views of one tree hold the same vessel mass in every epipolar plane. A line that one view alone
shows breaks that. So of the lines that may be no vessel (``imaging.stray_lines``) those are left
out, one after the other, without which the views agree far better. Catheters that both views show
agree as vessels do; they are for the segmentation to tell.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.stray_lines import stray_lines, without_line
from gcar_deploy.pose.pairwise import Pose

#: each line that is left out lowers the disagreement to this share at least
GAIN = 0.85
#: at least this share of a view's line stays
KEPT_SHARE = 0.5
#: of a view's lines the longest are asked
MOST_LINES = 8


def partnered(
    views: Sequence[VesselImage], poses: tuple[Pose, ...], asked: Sequence[bool], enough: float,
    estimate: Callable[[Sequence[VesselImage]], tuple[Pose, ...]],
) -> tuple[list[VesselImage], tuple[Pose, ...]]:  # fmt: skip
    """Leave out lines that no other view shows, until the views agree well enough.

    Parameters
    ----------
    views : V vessel images
    poses : what ``estimate`` says of them
    asked : of each view whether its lines may be left out
    enough : disagreement, 0 .. 1, from which on nothing more is asked
    estimate : poses of such views

    Returns
    -------
    views, poses : those that are not changed are the same objects
    """
    now, reduced = list(views), functools.cache(_reduced)  # few views change from round to round
    least = [KEPT_SHARE * view.skeleton.sum() for view in views]
    while (worst := max(pose.after for pose in poses)) > enough:
        tried = [
            [*now[:k], fewer, *now[k + 1 :]]
            for k, (view, few, may) in enumerate(zip(now, least, asked, strict=True))
            if may
            for fewer in reduced(view, few)
        ]
        if not tried:
            break
        found = [estimate(views) for views in tried]
        after = [max(pose.after for pose in poses) for poses in found]
        best = after.index(min(after))
        if after[best] > GAIN * worst:
            break
        now, poses = tried[best], found[best]
    return now, poses


def _reduced(view: VesselImage, least_px: float) -> list[VesselImage]:
    """Return the view without one of its lines, for each that leaves enough."""
    lines = sorted(stray_lines(view), key=lambda line: -int(line.sum()))[:MOST_LINES]
    left = [without_line(view, line) for line in lines]
    return [one for one in left if one is not None and one.skeleton.sum() >= least_px]
