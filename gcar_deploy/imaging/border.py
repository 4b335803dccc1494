"""Borders that show nothing: rows and columns that repeat what lies beside them, or are even.

A border that was added to a picture moves every percentile and every block of pixels that a
filter or a network works on. Without it the same picture gives the same vessels.
"""

from __future__ import annotations

import dataclasses
from typing import TypeAlias

import cv2
import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.types import Array, Image, Mask

#: less than this is left of no picture, pixels: an even picture is for others to refuse
LEAST_SIDE = 16
#: first row, row after the last, first column, column after the last
Box: TypeAlias = tuple[int, int, int, int]


def shown_box(pixels: Image) -> Box:
    """Box of the picture without borders that show nothing."""
    top, bottom = _shown(pixels)
    left, right = _shown(pixels.T)
    if bottom - top < LEAST_SIDE or right - left < LEAST_SIDE:
        return 0, pixels.shape[0], 0, pixels.shape[1]
    return top, bottom, left, right


def _shown(pixels: Image) -> tuple[int, int]:
    """First row that shows something, and the row after the last."""
    even = pixels.max(axis=1) == pixels.min(axis=1)
    if even.all():
        return 0, 0
    same = (pixels[1:] == pixels[:-1]).all(axis=1) & ~even[1:]
    last = len(pixels) - _border(pixels[::-1], even[::-1], same[::-1])
    return _border(pixels, even, same), last


def _border(pixels: Image, even: Array, same: Array) -> int:
    """Count the rows before the first that shows something."""
    first = int(np.argmin(even))
    if first and np.median(pixels[first]) == pixels[0, 0]:
        return 0  # an even background without noise: that there is no vessel is worth knowing
    while first < len(same) and same[first]:
        first += 1
    return first


def inward_px(valid: Mask) -> Image:
    """(rows, cols) float32, pixels: distance from where the picture, or its valid part, ends."""
    framed = cv2.copyMakeBorder(valid.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    return np.asarray(cv2.distanceTransform(framed, cv2.DIST_L2, 5)[1:-1, 1:-1])


def cut_out(angiogram: Angiogram, box: Box) -> Angiogram:
    """Return the part of a picture within a box, without what was drawn in it."""
    top, bottom, left, right = box
    rows, columns = slice(top, bottom), slice(left, right)
    valid = angiogram.valid
    return dataclasses.replace(
        angiogram,
        carm=_cropped(angiogram.carm, box),
        pixels=np.ascontiguousarray(angiogram.pixels[rows, columns]),
        valid=None if valid is None else valid[rows, columns],
        erased=None,
        painted=None,
        bare=tuple(np.ascontiguousarray(one[rows, columns]) for one in angiogram.bare),
    )


def put_back(found: VesselImage, angiogram: Angiogram, box: Box) -> VesselImage:
    """Return what was found within a box as a vessel image of the whole picture."""
    top, bottom, left, right = box
    shape, kept = angiogram.pixels.shape, found.kept
    room = (top, shape[0] - bottom), (left, shape[1] - right)

    def whole(array: Array) -> Array:
        return np.pad(array, room)

    return dataclasses.replace(
        found,
        carm=angiogram.carm,
        path_mm=whole(found.path_mm),
        mask=whole(found.mask),
        skeleton=whole(found.skeleton),
        valid=whole(found.valid),
        vesselness=None if found.vesselness is None else whole(found.vesselness),
        catheter=None if found.catheter is None else whole(found.catheter),
        device=None if found.device is None else whole(found.device),
        others=tuple(put_back(other, angiogram, box) for other in found.others),
        kept=None if kept is None else lambda: put_back(kept(), angiogram, box),
    )


def _cropped(carm: CArm, box: Box) -> CArm:
    top, bottom, left, right = box
    matrix = None
    if carm.projection_matrix is not None:
        S = np.array([[1.0, 0, -left], [0, 1.0, -top], [0, 0, 1.0]])
        matrix = tuple(map(tuple, (S @ np.asarray(carm.projection_matrix)).tolist()))
    column, row = carm.principal_point
    return dataclasses.replace(
        carm,
        rows=bottom - top,
        columns=right - left,
        principal_point_px=(column - left, row - top),
        projection_matrix=matrix,
    )
