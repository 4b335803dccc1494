"""One-pixel-wide centrelines of masks, and what hangs on them."""

from __future__ import annotations

import cv2
import numpy as np

from gcar_deploy.imaging.distance import exact_distance
from gcar_deploy.types import Array, Image, Mask, Scalars

_RING = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
#: of a line so much is looked at to each side, pixels
_AROUND_PX = 12
#: passes in which ends are cut: cutting one makes another
PRUNINGS = 3
_BLOCK = np.ones((3, 3), np.uint8)


def skeletonize(mask: Mask) -> Mask:
    """Thin a (rows, cols) mask to lines one pixel wide; connected stays connected.

    Parallel thinning of Guo and Hall (Communications of the ACM 32:359, 1989), what
    ``cv2.ximgproc.thinning`` does too, which looks at the whole picture for every layer that goes.
    Here a pixel is looked at again only where one beside it went.
    """
    here = np.ascontiguousarray(np.pad(mask, 1))
    ring = np.array([-1, -1, 0, 1, 1, 1, 0, -1]) * here.shape[1]  # clockwise from above
    ring += np.array([0, 1, 1, 1, 0, -1, -1, -1])
    on = here.reshape(-1)
    edge = cv2.erode(here.astype(np.uint8), _BLOCK, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    due = [np.flatnonzero(on & (edge.reshape(-1) == 0))] * 2
    number, half = np.empty(len(on), np.int32), 0
    while len(due[0]) or len(due[1]):
        at, due[half] = due[half], due[half][:0]
        around = (on[at[:, None] + ring] << np.arange(8)).sum(axis=1)
        gone = at[_GOES[half][around]]
        if len(gone):
            on[gone] = False
            beside = (gone[:, None] + ring).reshape(-1)
            beside = beside[on[beside]]
            due = [_once(np.concatenate([old[on[old]], beside]), number) for old in due]
        half = 1 - half
    return np.ascontiguousarray(here[1:-1, 1:-1])


def _once(at: Array, number: Array) -> Array:
    """Leave out what comes again; ``number`` is room for a number per pixel."""
    order = np.arange(len(at), dtype=number.dtype)
    number[at] = order
    return at[number[at] == order]


def _rules() -> tuple[Mask, Mask]:
    """(256,) whether a pixel with such neighbours goes, in the first and second half of a step."""
    p2, p3, p4, p5, p6, p7, p8, p9 = ((np.arange(256)[None] >> np.arange(8)[:, None]) & 1) > 0
    parts = (~p2 & (p3 | p4), ~p4 & (p5 | p6), ~p6 & (p7 | p8), ~p8 & (p9 | p2))
    one = sum(part.astype(int) for part in parts) == 1
    pairs = ((p9, p2, p3, p4, p5, p6, p7, p8), (p2, p3, p4, p5, p6, p7, p8, p9))
    least = np.minimum(*(sum((a | b).astype(int) for a, b in zip(p[::2], p[1::2], strict=True))
                         for p in pairs))  # fmt: skip
    goes = one & (least >= 2) & (least <= 3)
    return goes & ~((p6 | p7 | ~p9) & p8), goes & ~((p2 | p3 | ~p5) & p4)


def neighbours(skeleton: Mask) -> Array:
    """(rows, cols) uint8: how many of the eight neighbours are skeleton."""
    return cv2.filter2D(skeleton.astype(np.uint8), -1, _RING, borderType=cv2.BORDER_CONSTANT)


def stretches(skeleton: Mask) -> tuple[int, Array]:
    """Label the lines between forks from 1 on; a fork and what touches it belong to none.

    Returns
    -------
    count : int, of numbers, 0 with them
    label : (rows, cols) int32, 0 beside the lines
    """
    forks = cv2.dilate((skeleton & (neighbours(skeleton) >= 3)).astype(np.uint8), _BLOCK) > 0
    return cv2.connectedComponents((skeleton & ~forks).astype(np.uint8), connectivity=8)


def prune(skeleton: Mask, strength: Image, shortest_px: float, weakest: float) -> Mask:
    """Cut ends that are short or weak, in ``PRUNINGS`` passes at most.

    Parameters
    ----------
    skeleton : (rows, cols) bool
    strength : (rows, cols) float32, ridge response
    shortest_px : float
        A segment between an end and a fork with fewer pixels is a spur.
    weakest : float
        An end segment with a lower mean strength goes, however long.
    """
    for _ in range(PRUNINGS):
        count = neighbours(skeleton)
        forks = skeleton & (count >= 3)
        segments = skeleton & ~forks
        n, label = cv2.connectedComponents(segments.astype(np.uint8), connectivity=8)
        pixels, mean = _segment_means(label, segments, strength, n)
        at_end, at_fork = np.zeros(n, bool), np.zeros(n, bool)
        at_end[label[segments & (count <= 1)]] = True
        at_fork[label[cv2.dilate(forks.astype(np.uint8), _BLOCK) > 0]] = True
        cut = at_end & (((pixels < shortest_px) & at_fork) | (mean < weakest))
        cut[0] = False
        if not cut.any():
            break
        skeleton = skeletonize(skeleton & ~cut[label])
    return skeleton


def _segment_means(label: Array, inside: Mask, strength: Image, n: int) -> tuple[Scalars, Scalars]:
    pixels = np.bincount(label[inside], minlength=n).astype(np.float64)
    total = np.bincount(label[inside], weights=strength[inside], minlength=n)
    return pixels, total / np.maximum(pixels, 1)


def strong_parts(skeleton: Mask, strength: Image, share: float) -> Mask:
    """Keep connected parts whose summed strength is at least ``share`` of the best part's."""
    n, label = cv2.connectedComponents(skeleton.astype(np.uint8), connectivity=8)
    total = np.bincount(label[skeleton], weights=strength[skeleton], minlength=n)
    keep = total >= share * total.max()
    keep[0] = False
    return keep[label]


def parts_of_length(skeleton: Mask, least_px: float) -> Mask:
    """Keep connected parts whose line is at least so long, pixels."""
    n, label = cv2.connectedComponents(skeleton.astype(np.uint8), connectivity=8)
    length = arc_length(skeleton)
    keep = np.bincount(label[skeleton], weights=length[skeleton], minlength=n) >= least_px
    keep[0] = False
    return keep[label]


def parts_touching(mask: Mask, seeds: Mask) -> Mask:
    """Keep the connected parts of ``mask`` that hold at least one seed."""
    n, label = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    keep = np.zeros(n, bool)
    keep[label[seeds]] = True
    keep[0] = False
    return keep[label]


def spread(
    skeleton: Mask, values: tuple[Array, ...], smooth_px: float
) -> tuple[Image, tuple[Image, ...]]:
    """Average values along the skeleton and carry them to every pixel.

    Returns
    -------
    distance : (rows, cols) float32
        To the nearest skeleton pixel, pixels.
    carried : tuple of (rows, cols) float32
        Each value at that skeleton pixel, after a Gaussian average along the line.
    """
    distance, label = to_line(skeleton)
    weight = cv2.GaussianBlur(skeleton.astype(np.float32), (0, 0), smooth_px)
    carried = []
    for value in values:
        on_line = np.where(skeleton, value, 0).astype(np.float32)
        mean = cv2.GaussianBlur(on_line, (0, 0), smooth_px) / np.maximum(weight, 1e-9)
        carried.append(_carried(np.asarray(mean, dtype=np.float32), skeleton, label))
    return np.asarray(distance, dtype=np.float32), tuple(carried)


def averaged(
    skeleton: Mask, inside: Mask, off_line: Image, smooth_px: float
) -> tuple[Image, Image]:
    """Average the sections' ``off_line`` plus distance to the line, along the line.

    Returns
    -------
    distance : (rows, cols) float32
        To the nearest skeleton pixel, pixels.
    carried : (rows, cols) float32
        Mean of distance and ``off_line`` over the pixels of ``inside`` that are nearest to that
        skeleton pixel or, by a Gaussian weight, to those along the line from it.
    """
    distance, label = to_line(skeleton)
    which, many = label[inside], int(label.max()) + 1
    total = np.bincount(which, (distance + off_line)[inside], many).astype(np.float32)[label]
    count = np.bincount(which, minlength=many).astype(np.float32)[label]
    sums = [
        cv2.GaussianBlur(np.where(skeleton, value, np.float32(0)), (0, 0), smooth_px)
        for value in (total, count)
    ]
    mean = np.asarray(sums[0] / np.maximum(sums[1], 1e-9), dtype=np.float32)
    return np.asarray(distance, dtype=np.float32), _carried(mean, skeleton, label)


def beside(reach: Mask, skeleton: Mask, kept: Mask) -> Mask:
    """Pixels of ``reach`` whose nearest skeleton pixel is, or touches, one of ``kept``."""
    if not kept.any():
        return np.zeros_like(reach)
    near = cv2.dilate(kept.astype(np.uint8), _BLOCK) > 0
    return reach & nearest(near, skeleton)


def inscribed(reach: Mask, line: Mask) -> Mask:
    """Pixels within the circles that touch the rim of ``reach`` and have their middle on a line.

    A vessel seen end-on is a disc at the end of its line: nothing of it is a branch.
    """
    half = exact_distance(reach)
    out = np.zeros(reach.shape, np.uint8)
    for row, col in np.argwhere(line & reach).tolist():
        cv2.circle(out, (col, row), int(half[row, col]), 1, -1)
    return reach & (out > 0)


def beside_alone(reach: Mask, skeleton: Mask, part: Mask) -> Mask:
    """Pixels of ``reach`` that are ``beside`` a part of the skeleton and not beside the rest."""
    if not part.any():
        return np.zeros_like(reach)
    label = to_line(skeleton)[1]
    near, far = (
        _carried(cv2.dilate(own.astype(np.uint8), _BLOCK) > 0, skeleton, label)
        for own in (part, skeleton & ~part)
    )
    return reach & near & ~far


def mostly(line: Mask, inside: Mask) -> Mask:
    """Pixels of ``line`` around which most of it lies ``inside``."""
    size = (2 * _AROUND_PX + 1,) * 2
    count, share = (
        cv2.boxFilter(own.astype(np.float32), -1, size, normalize=False)
        for own in (line, line & inside)
    )
    return line & (share > 0.5 * count)


def to_line(skeleton: Mask) -> tuple[Array, Array]:
    """(rows, cols) each: distance to the nearest skeleton pixel, and that pixel's number."""
    return cv2.distanceTransformWithLabels(
        (~skeleton).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )


def nearest(values: Array, skeleton: Mask) -> Array:
    """(rows, cols) value at the nearest skeleton pixel."""
    return _carried(values, skeleton, to_line(skeleton)[1])


def _carried(values: Array, skeleton: Mask, label: Array) -> Array:
    """(rows, cols) value at the nearest skeleton pixel; ``label`` as ``to_line`` numbers them."""
    table = np.zeros(int(label.max()) + 1, values.dtype)
    table[label[skeleton]] = values[skeleton]
    return table[label]


def arc_length(skeleton: Mask) -> Image:
    """(rows, cols) float32: pixels of line that each pixel stands for, whichever way it runs."""
    half = np.array([[0.5**0.5, 0.5, 0.5**0.5], [0.5, 0, 0.5], [0.5**0.5, 0.5, 0.5**0.5]])
    line = skeleton.astype(np.float32)
    reach = cv2.filter2D(line, -1, half.astype(np.float32), borderType=cv2.BORDER_CONSTANT)
    return line * np.clip(reach, 0.5, 2**0.5)


_GOES = _rules()
