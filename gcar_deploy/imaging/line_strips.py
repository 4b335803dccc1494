"""What a picture shows along its lines: the table that the network of devices is asked with.

What is a catheter, a lead or a rib is told by its course, its evenness and where it comes from,
over a long way. So lines are looked at stretched out: at every point the picture across the line,
how the line bends there, and how it stands among the others.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from scipy import ndimage

from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.border import inward_px
from gcar_deploy.imaging.line_chains import chains
from gcar_deploy.types import Array, Mask, Scalars

#: pixels to each side of a line that are looked at, and maps that are: three of the picture, then
#: probability and chord of the segmenter
ACROSS_PX, MAPS = 8, 5
#: columns of a point after those: the first change sign where a line is mirrored, or is walked the
#: other way
SIGNED = 5
#: columns that belong to the way ahead and the way behind: they change places
SWAPPED = ((8, 9), (11, 12))
COURSE = 19
#: numbers that say all there is of a point
POINT = (2 * ACROSS_PX + 1) * MAPS + COURSE
#: a point is seen together with those so many steps away from it, in both directions
DILATIONS, _STEPS = (1, 2, 4, 8, 16, 32), (-2, -1, 0, 1, 2)
NEAR = len(DILATIONS) * len(_STEPS)
#: a line shorter than this has no course, pixels
SHORTEST_PX = 6
#: widest number of a point
_CLIP = 5.0
#: a line that ends so near to the border comes from there, pixels
_BORDER_PX = 10.0


@dataclasses.dataclass(frozen=True, eq=False)
class LinePoints:
    """Points along all lines of a picture, one pixel apart, line after line.

    Attributes
    ----------
    pixels : (n, 2) int, (row, col) nearest to each point
    points : (n, POINT) float32
    near : (n, NEAR) int64, numbers of the points that each is seen with; n beyond a line's end
    lengths : number of points of each line
    """

    pixels: Array
    points: Array
    near: Array
    lengths: tuple[int, ...]


def line_points(maps: Array, line: Mask, holes: Mask) -> LinePoints:
    """Look along the lines of a picture; no points where no line has a course.

    Parameters
    ----------
    maps : (MAPS, rows, cols) float32, at the network's ``SIDE``: ``net.net_input``, then
        probability and chord (pixel edges)
    line : (rows, cols) bool, one pixel wide
    holes : (rows, cols) bool, pixels without picture
    """
    found = []
    if line.any():
        around = _Around(maps, line, holes)
        found = [around.along(np.asarray(chain, float)) for chain in
                 chains(line, 2.0 + around.width) if len(chain) >= SHORTEST_PX]  # fmt: skip
    if not found:
        none = np.zeros((0, 2), np.int64)
        return LinePoints(none, np.zeros((0, POINT), np.float32), near_points(()), ())
    pixels, points = (np.concatenate(parts) for parts in zip(*found, strict=True))
    lengths = tuple(len(one) for one, _ in found)
    return LinePoints(pixels, points, near_points(lengths), lengths)


def near_points(lengths: tuple[int, ...]) -> Array:
    """(n, NEAR) int64: of each point the points seen with it; n where its line does not reach."""
    total = sum(lengths)
    last = np.cumsum(lengths)
    reach = np.ravel([[step * dilation for step in _STEPS] for dilation in DILATIONS])
    number = np.arange(total)[:, None] + reach
    begin, end = (np.repeat(edge, lengths)[:, None] for edge in (last - lengths, last))
    return np.where((number >= begin) & (number < end), number, total)


class _Around:
    """All that the points of one picture share."""

    def __init__(self, maps: Array, line: Mask, holes: Mask) -> None:
        self.width = np.maximum(maps[4], np.float32(1))
        self.maps = [*maps[:4], np.log1p(maps[4])]
        self.inward = inward_px(~holes)
        _, part = cv2.connectedComponents(line.astype(np.uint8), connectivity=8)
        size = np.bincount(part[line], minlength=int(part.max()) + 1)
        self.share = size[part] / max(int(line.sum()), 1)
        self.bright = np.asarray(cv2.GaussianBlur(maps[0], (0, 0), 1.0))
        self.brightest = max(float(np.percentile(self.bright[line], 90)), 1e-3)
        self.widest = max(float(np.percentile(self.width[line], 90)), 1e-3)
        forks = line & (skel.neighbours(line) > 2)
        to_fork = cv2.distanceTransform((~forks).astype(np.uint8), cv2.DIST_L2, 5)
        self.fork = np.exp(-to_fork / 6.0)

    def along(self, chain: Array) -> tuple[Array, Array]:
        """(n, 2) pixels and (n, POINT) numbers of the points of one line."""
        even = _evenly(chain)
        course = _smooth(even, 2.0)
        heading = np.gradient(course, axis=0)
        heading /= np.maximum(np.hypot(*heading.T), 1e-6)[:, None]
        normal = np.stack([-heading[:, 1], heading[:, 0]], axis=1)
        pixels = np.clip(np.rint(even).astype(int), 0, np.subtract(self.fork.shape, 1))
        across = self._across(course, normal)
        rest = [*_bends(course, heading, normal), *self._place(pixels)]
        points = np.concatenate([across, np.stack(rest, axis=1)], axis=1)
        return pixels, np.clip(points, -_CLIP, _CLIP).astype(np.float32)

    def _across(self, course: Array, normal: Array) -> Array:
        """(n, MAPS x (2 ACROSS_PX + 1)): each map across the line, map after map."""
        offset = np.arange(-ACROSS_PX, ACROSS_PX + 1)[None, :, None]
        at = (course[:, None] + offset * normal[:, None]).astype(np.float32)
        row, column = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
        seen = [
            cv2.remap(one, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for one in self.maps
        ]
        return np.concatenate(seen, axis=1)

    def _place(self, pixels: Array) -> list[Scalars]:
        """How the points stand to the field, to the ends of their line, and among all lines."""
        at = (pixels[:, 0], pixels[:, 1])
        inward = self.inward[at]
        count = len(pixels)
        ahead = np.arange(count)
        every = np.ones(count)
        return [
            np.exp(-inward / 8.0),
            np.minimum(inward / 60.0, 2.0),
            np.exp(-ahead / 12.0),
            np.exp(-ahead[::-1] / 12.0),
            min(count / 100.0, 3.0) * every,
            (inward[0] < _BORDER_PX) * every,
            (inward[-1] < _BORDER_PX) * every,
            self.fork[at],
            self.width[at] / self.widest,
            self.bright[at] / self.brightest,
            self.share[at],
            self.brightest * every,
            0.1 * self.widest * every,
        ]


def _bends(course: Array, heading: Array, normal: Array) -> list[Scalars]:
    """How a line turns over three lengths, how far it wavers over two, and how much it bends."""
    angle = np.unwrap(np.arctan2(heading[:, 0], heading[:, 1]))
    last = len(angle) - 1
    number = np.arange(len(angle))
    turns = [
        angle[np.minimum(number + way, last)] - angle[np.maximum(number - way, 0)]
        for way in (3, 8, 20)
    ]
    wavers = [((course - _smooth(course, way)) * normal).sum(axis=1) for way in (5.0, 12.0)]
    bend = ndimage.gaussian_filter1d(np.abs(np.gradient(angle)), 10.0, mode="nearest")
    return [*turns, *wavers, 10.0 * bend]


def _evenly(chain: Array) -> Array:
    """(n, 2) points one pixel apart along a line."""
    step = np.hypot(*np.diff(chain, axis=0).T)
    chain = chain[np.concatenate([[True], step > 0])]
    way = np.concatenate([[0.0], np.cumsum(step[step > 0])])
    at = np.linspace(0.0, way[-1], int(way[-1]) + 1)
    return np.stack([np.interp(at, way, chain[:, k]) for k in (0, 1)], axis=1)


def _smooth(points: Array, sigma: float) -> Array:
    """Gaussian average along a line that goes on beyond its ends as it came."""
    more = min(len(points) - 1, int(4 * sigma))
    before = 2 * points[0] - points[more:0:-1]
    after = 2 * points[-1] - points[-2 : -more - 2 : -1]
    longer = np.concatenate([before, points, after])
    return np.asarray(ndimage.gaussian_filter1d(longer, sigma, axis=0)[more : more + len(points)])


def mirrored(points: Array) -> Array:
    """(n, POINT) of the same lines seen in a mirror."""
    across, rest = _parts(points)
    rest[:, :SIGNED] *= -1
    return _joined(across[..., ::-1], rest)


def backwards(points: Array, lengths: tuple[int, ...]) -> Array:
    """(n, POINT) of the same lines, each walked from its other end; the lines in their order."""
    points = np.concatenate([p[::-1] for p in np.split(points, np.cumsum(lengths)[:-1])])
    across, rest = _parts(points)
    rest[:, :SIGNED] *= -1
    for one, other in SWAPPED:
        rest[:, [one, other]] = rest[:, [other, one]]
    return _joined(across[..., ::-1], rest)


def _parts(points: Array) -> tuple[Array, Array]:
    across = points[:, : POINT - COURSE].reshape(len(points), MAPS, -1)
    return across, points[:, POINT - COURSE :].copy()


def _joined(across: Array, rest: Array) -> Array:
    return np.concatenate([across.reshape(len(across), -1), rest], axis=1)
