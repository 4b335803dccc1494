"""Lines that stood in a picture before contrast came: catheters, leads, wires, ribs; no vessels.

A run mostly begins before contrast is given. What is a line there already, of the same course and
about as strong, is none of the vessels that contrast shows, whatever it looks like. It need not be
in the same place: the heart beats, the patient breathes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.imaging import enhance
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.fusion import without_lines
from gcar_deploy.imaging.line_chains import chains
from gcar_deploy.imaging.net import NOMINAL_MM, at_network_size
from gcar_deploy.types import Array, Image, Mask

#: a line is compared piece by piece, and a shorter one not at all; pixels of the network
PIECE_PX, _SHORTEST_PX = 40, 10
#: so far it may have stood from where it is, pixels of the network each way
REACH_PX = 8
#: and was so strong, as a share of what it is
STOOD = 0.6
#: where more than this share of all lines stood before, contrast had come already
_MOST = 0.6
_BLUR_PX = 1.0


def without_standing(
    found: VesselImage, picture: Image, before: Sequence[Image], holes: Mask
) -> VesselImage:
    """Cut the lines that stood before contrast came, out of what each method saw, too.

    Parameters
    ----------
    found : of the picture
    picture : (rows, cols) float32, vessels bright
    before : the same of frames of its run that hold no contrast yet
    holes : (rows, cols) bool, pixels without picture
    """
    now, stood = _lines(picture, holes), [_lines(one, holes) for one in before]
    scale = now.shape[1] / picture.shape[1]
    own = standing(found, now, stood, scale)
    if not own.any():
        return found
    rest = tuple(without_lines(one, standing(one, now, stood, scale)) for one in found.others)
    left = without_lines(found, own)
    seen = own if found.catheter is None else own | found.catheter
    length_mm = float(own.sum()) * found.carm.pixel_at_isocenter_mm
    return dataclasses.replace(
        left, others=rest, catheter=seen & ~left.mask, catheter_mm=found.catheter_mm + length_mm
    )


def what_came(picture: Image, before: Sequence[Image], holes: Mask) -> Image:
    """(rows, cols) float32: 1 on ridges that are much stronger than all near them before, else 0.

    Parameters are those of ``without_standing``. Where a line that looks like a device came with
    the contrast it is none.
    """
    now, stood = _lines(picture, holes), [_lines(one, holes) for one in before]
    around = np.ones((2 * REACH_PX + 1,) * 2, np.uint8)
    near = cv2.dilate(np.max(stood, axis=0), around)
    came = ((now > 0) & (near < STOOD * now)).astype(np.float32)
    return np.asarray(cv2.resize(came, picture.shape[::-1], interpolation=cv2.INTER_NEAREST))


def standing(view: VesselImage, now: Image, before: Sequence[Image], scale: float) -> Mask:
    """(rows, cols) bool: parts of the skeleton that stood before; none where most of it did.

    Parameters
    ----------
    view : what was found
    now, before : ridge response of its picture, and of the frames before contrast
    scale : pixels of those for one of the view's
    """
    line = view.skeleton
    width = 2.0 + view.path_mm / view.carm.pixel_at_isocenter_mm
    marks = np.zeros((2, *line.shape), bool)
    for chain in chains(line, width):
        points = np.asarray(chain)
        length = len(points) * scale
        if length < _SHORTEST_PX:
            continue
        for piece in np.array_split(points, max(1, round(length / PIECE_PX))):
            row, col = np.rint(piece).astype(int).T
            marks[int(_stood(np.rint(piece * scale).astype(int), now, before)), row, col] = True
    # Where lines cross, a vessel goes on.
    beside = cv2.dilate(marks[0].astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    out: Mask = marks[1] & line & ~beside
    return out if out.sum() <= _MOST * line.sum() else np.zeros_like(line)


def _stood(piece: Array, now: Image, before: Sequence[Image]) -> bool:
    """Whether a piece, (n, 2) of (row, col), is found again in any of the frames before."""
    reach = np.arange(-REACH_PX, REACH_PX + 1)
    shifts = np.stack(np.meshgrid(reach, reach, indexing="ij"), axis=-1).reshape(-1, 1, 2)
    last = np.subtract(now.shape, 1)
    row, col = np.moveaxis(np.clip(piece + shifts, 0, last), -1, 0)
    at = tuple(np.clip(piece, 0, last).T)
    most = max(float(one[row, col].mean(axis=1).max()) for one in before)
    return most >= STOOD * float(now[at].mean())


def _lines(picture: Image, holes: Mask) -> Image:
    """Ridge response at the network's size, 0 where there is no picture."""
    work, work_holes = at_network_size(picture, holes)
    filled = enhance.fill_holes(work, work_holes)
    flat = enhance.flatten(filled, enhance.FLATTEN_SIGMA_MM / NOMINAL_MM)
    response = np.where(work_holes, np.float32(0), enhance.ridges(flat, NOMINAL_MM).response)
    return np.asarray(cv2.GaussianBlur(response, (0, 0), _BLUR_PX))
