"""Lines of the pictures that no tube explains: what whoever chose the starting points missed."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import cv2
import numpy as np
from scipy import ndimage

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.line_chains import chains
from gcar_deploy.tubes.model import Footprint
from gcar_deploy.tubes.targets import Target
from gcar_deploy.types import Array, Image, Pixels

#: a line counts where tubes leave this share of its path, over so many mm at the isocentre ...
MISSED_SHARE, MIN_LENGTH_MM = 0.5, 6.0
#: ... with holes up to this long; it is followed beyond its ends, to where it leaves the tree, mm
HOLE_MM, BEYOND_MM = 2.0, 6.0
#: a line that is a catheter, lead or wire with this mean probability is none
MOST_DEVICE = 0.2
#: paths are compared as means over this box, and tubes reach so much farther: fits are off by that
BOX_MM, NEAR_MM = 1.0, 0.7
#: path of no vessel, mm
LEAST_PATH_MM = 0.2


@dataclasses.dataclass(frozen=True, eq=False)
class Look:
    """What one picture shows, and what of it no tube explains; both as means over ``BOX_MM``.

    Attributes
    ----------
    view : VesselImage
    target : Target of the picture's own pixels
    seen_mm, left_mm : (rows, cols) float32, path in the model's mm
    """

    view: VesselImage
    target: Target
    seen_mm: Image
    left_mm: Image

    @functools.cached_property
    def missed(self) -> Array:
        """(rows, cols) share of the path that no tube explains."""
        return self.left_mm / np.maximum(self.seen_mm, np.float32(LEAST_PATH_MM))


@dataclasses.dataclass(frozen=True, eq=False)
class MissedLine:
    """A line that one view shows and no tube explains.

    Attributes
    ----------
    view : number of the view, from 0
    pixels : (m, 2) (col, row) along it, followed beyond its ends
    core : what of them is missed
    """

    view: int
    pixels: Pixels
    core: slice


def looked_at(
    views: Sequence[VesselImage], targets: Sequence[Target], prints: Sequence[Footprint]
) -> list[Look]:
    """Compare pictures with tubes.

    Parameters
    ----------
    views, targets, prints : one each per view; targets are of the pictures' own pixels
    """
    return [_look(*one) for one in zip(views, targets, prints, strict=True)]


def _look(view: VesselImage, target: Target, seen: Footprint) -> Look:
    box = 2 * round(0.5 * BOX_MM / target.pixel_mm) + 1
    near = 2 * round(NEAR_MM / target.pixel_mm) + 1
    path = target.path_mm / target.contrast
    reach = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (near, near))
    model = cv2.dilate(seen.image(target.path_mm.shape).astype(np.float32), reach)
    shown, told = (cv2.blur(picture.astype(np.float32), (box, box)) for picture in (path, model))
    left = np.where(view.valid, np.maximum(shown - told, 0), 0)
    return Look(view, target, shown.astype(np.float32), left.astype(np.float32))


def missed_lines(looks: Sequence[Look]) -> list[MissedLine]:
    """Find the lines that no tube explains."""
    return [line for number, look in enumerate(looks) for line in _lines(number, look)]


def _lines(number: int, look: Look) -> list[MissedLine]:
    line, px = look.view.skeleton, look.target.pixel_mm
    hole, least = max(round(HOLE_MM / px), 1), MIN_LENGTH_MM / px
    missed = look.missed > MISSED_SHARE
    # Tracing lines takes far longer than to see that there are none.
    around = np.ones((2 * hole + 1, 2 * hole + 1), np.uint8)
    near = (cv2.dilate((line & missed).astype(np.uint8), around) > 0) & line
    if cv2.connectedComponentsWithStats(near.astype(np.uint8))[2][1:, 4].max(initial=0) < least:
        return []
    width: Image = 2 * cv2.distanceTransform(
        look.view.mask.astype(np.uint8), cv2.DIST_L2, 5
    ).astype(np.float32, copy=False)
    beyond, device = round(BEYOND_MM / px), look.view.device
    out = []
    for chain in chains(line, width):
        at = np.array(chain)
        open_ = np.pad(missed[at[:, 0], at[:, 1]], 2 * hole)
        open_ = ndimage.binary_closing(open_, iterations=hole)[2 * hole : -2 * hole]
        for (run,) in ndimage.find_objects(ndimage.label(open_)[0]):
            row, col = at[run].T
            if len(row) < least or (device is not None and device[row, col].mean() > MOST_DEVICE):
                continue
            first, last = max(run.start - beyond, 0), min(run.stop + beyond, len(at))
            pixels = at[first:last, ::-1].astype(np.float64)
            out.append(MissedLine(number, pixels, slice(run.start - first, run.stop - first)))
    return out
