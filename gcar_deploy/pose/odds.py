"""Which line of two raw pictures that contradict each other is likeliest to be no vessel.

Four witnesses speak: the network of devices, the crossings that the other view lacks, how much
better the views agree without the line, and whether it comes from outside where the other view has
a device from there. None suffices, but their log odds add up.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.distance import exact_distance
from gcar_deploy.imaging.line_chains import chains
from gcar_deploy.imaging.stray_lines import (
    INSIDE,
    SHORTEST_MM,
    comes_from_outside,
    drawn,
    likely_devices,
    stray_lines,
    without_line,
)
from gcar_deploy.pose.crossings import Surplus
from gcar_deploy.pose.pairwise import Pose, worst_of
from gcar_deploy.types import Mask

#: log odds for what the network says (on the log odds of its word), for a surplus of 1, for views
#: that agree e times better, and for a line from outside. Rounded from a logistic regression on
#: 1,478 lines of generated cath-lab pairs (seeds 88001, 91101 to 91105), 107 of them devices
SAID, SURPLUS, AGREE, OUTSIDE = 1.2, 2.0, 4.5, 1.4
#: the network is surer than it should be of what it never met: its word ends so far from 0 and 1
DOUBT = 0.05
#: views that agree better count for no more: what the network is sure of as a vessel stays, or two
#: patients would be trimmed until they agree
MOST_AGREE = 2.0
#: a line goes from these log odds on: 0.7 to 0.3
LEAST_ODDS = 0.85
#: so many of the likeliest are asked for how well the views agree without them, none of which the
#: other witnesses think so little
MOST_ASKED, LEAST_ASKED = 6, -3.0
#: disagreements below this are no better than it
_NOTHING = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Line:
    """A line that may be no vessel.

    Attributes
    ----------
    view : VesselImage that shows it
    pixels : (rows, cols) bool part of the view's skeleton
    left : the view without it
    """

    view: VesselImage
    pixels: Mask
    left: VesselImage

    @functools.cached_property
    def said(self) -> float:
        """0 .. 1, what the network of devices says; 0 where it was not asked."""
        device = self.view.device
        return 0.0 if device is None else float(device[self.pixels].mean())

    @functools.cached_property
    def outside(self) -> bool:
        """Whether it reaches the border of the field."""
        return comes_from_outside(self.view, self.pixels)


def left_out(view: VesselImage, parts: Iterable[Mask]) -> Iterator[Line]:
    """Yield the lines of which something is left of the view without them."""
    for pixels in parts:
        left = without_line(view, pixels)
        if left is not None:
            yield Line(view, pixels, left)


def lines_of(view: VesselImage) -> tuple[Line, ...]:
    """Return all lines of a view that could be left out of it."""
    length = view.skeleton.sum()
    # Where lines lie side by side nothing may go with one of them.
    return tuple(
        line
        for line in left_out(view, _parts(view))
        if line.left.skeleton.sum() <= length - 0.5 * line.pixels.sum()
    )


def _parts(view: VesselImage) -> Iterator[Mask]:
    yield from stray_lines(view)
    yield from likely_devices(view, INSIDE)
    least = SHORTEST_MM / view.carm.pixel_at_isocenter_mm
    for chain in chains(view.skeleton, (2 * exact_distance(view.mask)).astype(np.float32)):
        if len(chain) >= least:
            yield drawn(view.skeleton, chain)


def without_likeliest(
    views: Sequence[VesselImage],
    poses: tuple[Pose, ...],
    asked: Sequence[bool],
    least_px: Sequence[float],
    devices: Sequence[bool],
    lines: Callable[[VesselImage], Sequence[Line]],
    estimate: Callable[[Sequence[VesselImage]], tuple[Pose, ...]],
) -> tuple[list[VesselImage], tuple[Pose, ...]] | None:
    """Leave out of two views the line that is likeliest to be no vessel.

    Parameters
    ----------
    views, poses : two each
    asked : of each view whether its lines may be left out
    least_px : so much of each view's line stays
    devices : whether each view shows a device from outside
    lines : ``lines_of``, which takes a while
    estimate : poses of such views

    Returns
    -------
    views and poses without it; None where no line has the odds
    """
    carms = [pose.applied(view.carm) for pose, view in zip(poses, views, strict=True)]
    found: list[tuple[float, int, Line]] = []
    for k, view in enumerate(views):
        if not asked[k]:
            continue
        surplus = Surplus(view.skeleton, carms[k], views[1 - k].skeleton, carms[1 - k])
        found += [
            (_odds(line, surplus.share(line.pixels), devices[1 - k]), k, line)
            for line in lines(view)
            if line.left.skeleton.sum() >= least_px[k]
        ]
    found.sort(key=lambda one: -one[0])
    best, out = LEAST_ODDS, None
    for odds, k, line in found[:MOST_ASKED]:
        if odds < LEAST_ASKED:
            break
        fewer = [line.left if j == k else view for j, view in enumerate(views)]
        closer = estimate(fewer)
        better = AGREE * math.log((worst_of(poses) + _NOTHING) / (worst_of(closer) + _NOTHING))
        odds += min(better, MOST_AGREE)
        if odds > best:
            best, out = odds, (fewer, closer)
    return out


def _odds(line: Line, surplus: float, device_elsewhere: bool) -> float:
    """Log odds of a line without what the views say when it is gone."""
    said = math.log((line.said + DOUBT) / (1.0 + DOUBT - line.said))
    return SAID * said + SURPLUS * surplus + OUTSIDE * (device_elsewhere and line.outside)
