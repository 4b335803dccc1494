"""Vessels on an even ground, as other programs draw them: no filter is needed to see them.

A rendered tree, or a mask saved as a grey picture, has nothing beside its vessels: half of the
pixels are one grey value. What stands out of it is vessel, to the rim, however thin or wide.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.border import inward_px
from gcar_deploy.imaging.distance import exact_distance
from gcar_deploy.imaging.resample import blocks
from gcar_deploy.imaging.segment import PART_SHARE
from gcar_deploy.types import Array, Image, Mask

#: the ground is even if the robust standard deviation of all pixels is at most this share of the
#: deepest vessels, and hardly any pixel stands out the other way
_SPREAD, _OTHER_WAY = 0.03, 0.02
#: share of a block that lies below its middle by what counts as vessel, from which on its grain
#: would pass for one; of steps of one grey value 0.026 do where vessels lift the middle
_ROUGH = 0.03
#: what stands out by so many deviations, and by this share of the deepest, is no ground
_DEVIATIONS, _LEAST = 4.0, 0.02
#: the rim of a vessel, as a share of its middle: where a round vessel is 0.98 of its radius away
RIM_SHARE = 0.2
#: shadows are lines: at most so much of the picture, and no wider from the middle, mm
_AREA, _HALF_WIDTH_MM = 0.3, 8.5
#: connected lines that are shorter are letters, however black, mm
_LEAST_PART_MM = 8.0
#: a shadow is flat where this share of it is nearly as dark as its darkest part
_FLAT_SHARE, _NEARLY = 0.8, 0.9
#: a smooth ground: degree of the surface along each axis, cells it is fitted to, rounds of the fit
_DEGREE, _CELLS, _ROUNDS = 4, 32, 8
#: of blocks so large, mm, of whose pixels at most this percentage is vessel, at most so many may
#: have a ground that is off by this share of what counts as vessel: a cloud that no smooth
#: surface follows is no vessel, however narrow its top
_BLOCK_MM, _BLOCK_VESSEL, _BLOCKS_OFF, _OFF_SHARE = 18.0, 75, 2, 0.5
#: rows and columns that tell whether the ground is even
_SAMPLES = 500
#: the deepest vessels: so much of the picture is darker, mm^2, however much ground lies beside it.
#: With 20 one of the 40 real pictures passes for an even ground, with 30 none comes near
_DARKER_MM2 = 30.0
#: grain is blurred by so much until the ground is even
_BLURS_PX = (0.0, 1.0, 2.0)
#: so near to what stands out, pixels, the ground of a line stands out by less than this share of
#: the line itself; speckles on a cloud's top have the cloud beside them
_BESIDE_PX, _BESIDE_SHARE = 4, 0.4
#: so near to the picture's border its shadow reaches it, pixels
TOUCHING_PX = 1.5
#: what reaches the border in places so far apart, as a share of the shorter side, runs across
_ACROSS = 0.7
#: middles are averaged over so much of the line, pixels
_ALONG_PX = 3.0


@dataclasses.dataclass(frozen=True, eq=False)
class Shadow:
    """Vessels on an even ground.

    Attributes
    ----------
    mask : (rows, cols) bool
    flat : bool, of one grey value: it shows where vessels are and nothing of their depth
    shaded : bool, the ground is a smooth surface: less light falls on some of the picture
    """

    mask: Mask
    flat: bool
    shaded: bool


def shadow(picture: Image, holes: Mask, pixel_mm: float) -> Shadow | None:
    """Return the vessels of a picture whose ground is even, None of any other picture.

    Parameters
    ----------
    picture : (rows, cols) float32, vessels bright, any scale and offset
    holes : (rows, cols) bool, pixels without picture
    pixel_mm : pixel size at the isocentre
    """
    step = max(1, min(picture.shape) // _SAMPLES)
    seen = ~holes[::step, ::step]
    if not seen.any():
        return None
    for shaded, ground in enumerate(_grounds(picture, holes)):
        sharp = np.where(holes, 0.0, picture - ground).astype(np.float32)
        for blur in _BLURS_PX:
            rise = cv2.GaussianBlur(sharp, (0, 0), blur) if blur else sharp
            few = rise[::step, ::step][seen]
            deepest = _deepest(few, step * pixel_mm)
            spread = 1.4826 * float(np.median(np.abs(few)))
            if deepest > 0 and spread <= _SPREAD * deepest:
                floor = max(_DEVIATIONS * spread, _LEAST * deepest)
                shown = np.where(seen, rise[::step, ::step], np.nan)
                parts = _shown_blocks(shown, _BLOCK_MM / (step * pixel_mm))
                if _blocks_off(parts, floor) or _blocks_rough(parts, floor):
                    return None
                rise = np.asarray(rise, np.float32)
                found = _of_rise(rise, holes, (floor, deepest), pixel_mm)
                return found and Shadow(*found, shaded=bool(shaded))
    return None


def _grounds(picture: Image, holes: Mask) -> Iterator[Array | float]:
    """Yield one grey value, then a smooth surface: a light that falls off to the borders."""
    yield float(np.median(picture[~holes]))
    size = (_CELLS, _CELLS)
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float64)
    seen = cv2.resize(holes.astype(np.float32), size, interpolation=cv2.INTER_AREA) == 0
    at = [np.linspace(-1, 1, n) for n in (_CELLS, *picture.shape)]
    one, rows, columns = (np.polynomial.chebyshev.chebvander(x, _DEGREE) for x in at)
    terms = np.einsum("ia,jb->ijab", one, one).reshape(_CELLS**2, -1)
    used = seen.ravel()
    for _ in range(_ROUNDS):
        if used.sum() < 2 * terms.shape[1]:
            return
        surface = np.linalg.lstsq(terms[used], small.ravel()[used], rcond=None)[0]
        off = small.ravel() - terms @ surface
        # Vessels stand out to one side alone.
        used = seen.ravel() & (off <= 1.4826 * np.median(np.abs(off[used])))
    yield rows @ surface.reshape(_DEGREE + 1, _DEGREE + 1) @ columns.T


def _deepest(rise: Array, pixel_mm: float) -> float:
    darker = min(round(_DARKER_MM2 / pixel_mm**2), len(rise) - 1)
    return float(np.partition(rise, -1 - darker)[-1 - darker])


def _shown_blocks(rise: Array, side: float) -> list[Array]:
    """Split a picture into blocks, of each what is shown there; of those at least half shown."""
    down, across = (max(1, round(count / side)) for count in rise.shape)
    return [
        inside
        for block in blocks(rise, down, across)
        if (inside := block[np.isfinite(block)]).size > block.size // 2
    ]


def _blocks_off(parts: Sequence[Array], floor: float) -> bool:
    """Whether the ground of some blocks lies higher or lower than that of the picture."""
    grounds = [np.percentile(inside, 100 - _BLOCK_VESSEL) for inside in parts]
    off = np.abs(np.asarray(grounds) - np.median(grounds)) if grounds else np.zeros(0)
    return int((off > _OFF_SHARE * floor).sum()) > _BLOCKS_OFF


def _blocks_rough(parts: Sequence[Array], floor: float) -> bool:
    """Whether the grain of some block would pass for vessel: it stands out the other way as well.

    Of the same light a logarithm makes more noise where the picture is dark.
    """
    for inside in parts:
        middle = float(np.median(inside))
        if middle < floor and float((inside < middle - floor).mean()) > _ROUGH:
            return True
    return False


def _on_ground(line: Mask, reach: Mask, rise: Image) -> Mask:
    """Leave out connected lines without ground beside them: speckles on the top of a cloud."""
    count, part = cv2.connectedComponents(line.astype(np.uint8), connectivity=8)
    near = cv2.dilate(reach.astype(np.uint8), np.ones((2 * _BESIDE_PX + 1,) * 2, np.uint8)) > 0
    ring = near & ~reach
    beside = skel.nearest(part, line)[ring]
    ground, deep = (
        np.bincount(of, rise[at], count) / np.bincount(of, minlength=count).clip(1)
        for of, at in ((beside, ring), (part[line], line))
    )
    kept = ground < _BESIDE_SHARE * deep
    kept[0] = False
    out: Mask = kept[part]
    return out


def _across(mask: Mask, holes: Mask) -> bool:
    """Whether something runs across the whole picture, as ribs and wires do beside vessels."""
    border = inward_px(~holes) <= TOUCHING_PX
    _, part = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    farthest = _ACROSS * min(mask.shape)
    for k in np.unique(part[border & mask]):
        ends = np.argwhere((part == k) & border)
        if np.hypot(*np.ptp(ends, axis=0)) > farthest:
            return True
    return False


def _of_rise(
    rise: Image, holes: Mask, levels: tuple[float, float], pixel_mm: float
) -> tuple[Mask, bool] | None:
    """Mask of what stands out by a floor, and whether it is flat; None where it is no lines.

    ``levels`` are the floor and the deepest vessels.
    """
    floor, deepest = levels
    if float((rise < -floor).mean()) > _OTHER_WAY:
        return None
    reach = rise > floor
    line = skel.skeletonize(reach)
    wide = exact_distance(reach).max() * pixel_mm > _HALF_WIDTH_MM
    if not line.any() or reach.mean() > _AREA or wide:
        return None
    kept = _on_ground(line, reach, rise)
    kept &= skel.parts_of_length(kept, _LEAST_PART_MM / pixel_mm)
    kept = skel.strong_parts(kept, rise, PART_SHARE)
    if not kept.any():
        return None
    own = skel.beside(reach, line, kept)
    if _across(own, holes):
        return None
    _, (peak,) = skel.spread(line, (rise,), _ALONG_PX)
    mask = ((rise > RIM_SHARE * peak) | kept) & own
    dark = rise[mask] >= _NEARLY * deepest
    return mask, bool(dark.mean() >= _FLAT_SHARE)
