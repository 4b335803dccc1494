"""Vessels of a picture as the network sees them: mask, skeleton and path lengths.

The network says where vessels are and how deep they look: that holds in clutter, but is as coarse
as its input. The contrast against what surrounds the vessels is fine, but of unknown scale and
full of whatever else is there. So the network says where to read the contrast, and its chords give
the scale of paths. Masks are drawn by the mean of both.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TypeAlias

import cv2
import numpy as np

from gcar_deploy.imaging import enhance, segment
from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.bands import without_bands
from gcar_deploy.imaging.catheter import catheters
from gcar_deploy.imaging.contrast import scaled_contrast
from gcar_deploy.imaging.device_lines import device_map, device_parts, is_between
from gcar_deploy.imaging.distance import exact_distance
from gcar_deploy.imaging.net import (
    NOMINAL_MM,
    SIDE,
    Seen,
    Segmenter,
    at_network_size,
    net_input,
)
from gcar_deploy.imaging.resample import resize
from gcar_deploy.types import Array, Image, Mask

#: hysteresis on the network's probability: what is faint counts where it touches what is sure
LEVELS = (0.15, 0.5)
#: a side branch shorter than this is a spur, pixels of the network
SPUR_PX = 12
#: an end of a branch shallower than this share of the main vessels is a twig
TWIG_SHARE = 0.05
#: rim of the mask, as a share of the path in the middle: between the shadow and what experts draw
RIM_SHARE = 0.5
#: a line whose contrast is less than this share of what its chord would give is none
CONTRAST_SHARE = 0.1
#: paths are averaged over so much of the line before they say where the rim is, and blurred by so
#: much, pixels of the network
_ALONG_PX, _BLUR_PX = 3.0, 0.7
#: a line of one picture alone is left out where it is so probably no vessel, as long as no more
#: than this share of all lines goes
DEVICE_LEVEL, DEVICE_SHARE = 0.95, 0.8
#: where its line is so many times as wide as in its middle, a device touches a vessel
WIDER = 1.5
#: what is vessel, and how deep
Found: TypeAlias = tuple[segment.Segmentation, Image]


def learned_vessels(
    pictures: Mapping[str, Image],
    holes: Mask,
    pixel_mm: float,
    segmenter: Segmenter,
) -> tuple[Found, Callable[[], Found] | None]:
    """Find bright vessels and how deep they are.

    Parameters
    ----------
    pictures : name -> (rows, cols) float32, vessels bright
        ``search`` is what the network sees (the first where there is none), ``display`` is about
        linear in the path; ``came`` as in ``segment.segment``.
    holes : (rows, cols) bool, pixels without picture (collimator)
    pixel_mm : float, pixel size at the isocentre
    segmenter : Segmenter

    Returns
    -------
    found : Segmentation, at the picture's own size, and (rows, cols) float32
        The mask ends at a share of the path in the middle; its ``vesselness`` is the network's
        probability. Where vessels are does not depend on ``pixel_mm``. Length of the ray within
        vessel, mm, 0 away from vessels; it reaches beyond the mask.
    kept : gives the same with nothing taken for a device; None where nothing was, or where frames
        before contrast say what is one
    """
    search = enhance.searched(pictures)
    work, work_holes = at_network_size(search, holes)
    fine = net_input(work, work_holes)
    seen = segmenter.look(fine)
    reach, line, told = _lines(segmenter, fine, seen, work_holes)
    shown = resize(enhance.fill_holes(pictures["display"], holes), work.shape[::-1])
    vessels = without_bands(seen, reach, line, told, shown, work_holes, nominal_mm(work))
    if vessels is not seen:
        seen = vessels
        reach, line, told = _lines(segmenter, fine, seen, work_holes)
    device = devices(told, reach, line, work, work_holes)
    if "came" in pictures:
        came = resize(pictures["came"], work.shape[::-1]) > 0.5
        new = skel.beside(reach, line, skel.mostly(line, came))
        device, told = device & ~new, np.where(new, np.float32(0), told)

    def drawn(device: Mask) -> Found:
        return _found(pictures, holes, pixel_mm, seen, work_holes, device, told)

    asks = device.any() and "came" not in pictures
    return drawn(device), (lambda: drawn(np.zeros_like(device))) if asks else None


def _lines(
    segmenter: Segmenter, channels: Array, seen: Seen, holes: Mask
) -> tuple[Mask, Mask, Image]:
    """Where lines are seen, their centrelines, and how probably each is a device."""
    reach, line = vessel_lines(np.where(holes, np.float32(0), seen.probability))
    return reach, line, device_map(segmenter, channels, seen, line, reach, holes)


def _found(
    pictures: Mapping[str, Image], holes: Mask, pixel_mm: float, seen: Seen, work_holes: Mask,
    device: Mask, told: Image,
) -> Found:  # fmt: skip
    """Draw what is seen, without holes and devices; see ``learned_vessels``."""
    search = enhance.searched(pictures)
    other = work_holes | device
    seen = dataclasses.replace(seen, probability=np.where(other, np.float32(0), seen.probability))
    full = search.shape[::-1]
    finer = float(np.sqrt(search.size / device.size))
    work_mm = np.float32(pixel_mm * finer)
    sure = support(seen, LEVELS)
    near = (resize(sure.astype(np.float32), full) >= 0.5) & ~holes
    chord = np.where(near, resize(seen.chord, full) * work_mm, np.float32(0))
    contrast = scaled_contrast(pictures["display"], holes, near, chord, pixel_mm)
    near = _with_contrast(near, chord, contrast, finer)
    path = np.where(near, contrast, np.float32(0))
    # A rim is best seen by both: chords end where an observer draws it, contrast is fine.
    mask = _drawn(np.where(near, 0.5 * (chord + contrast), np.float32(0)), near, finer)
    device = device & ~sure
    found = dataclasses.replace(
        segment.given(search, mask, holes, pixel_mm),
        vesselness=np.where(holes, np.float32(0), resize(seen.probability, full)),
        catheter=(resize(device.astype(np.float32), full) >= 0.5) & ~mask,
        catheter_mm=int(skel.skeletonize(device).sum()) * float(work_mm),
        device=resize(told, full),
    )
    return found, path


def devices(told: Image, reach: Mask, line: Mask, picture: Image, holes: Mask) -> Mask:
    """(rows, cols) bool: lines that are no vessels, as wide as they reach.

    By what the network of lines says, or by their course among the vessels. Pixels are taken for as
    large as the network's filters take them.
    """
    if not line.any():
        return np.zeros_like(reach)
    filled = enhance.fill_holes(picture, holes)
    pixel_mm = nominal_mm(picture)
    finer = NOMINAL_MM / pixel_mm
    flat = enhance.flatten(filled, enhance.FLATTEN_SIGMA_MM / pixel_mm)
    sigma_px = enhance.ridges(flat, pixel_mm).sigma_px
    half = exact_distance(reach)
    found = np.zeros_like(reach)
    course = catheters(line, flat, sigma_px, ~holes, pixel_mm)
    parts = [course, *device_parts(line, told, DEVICE_LEVEL, finer)]
    rest = line & ~np.any(parts, axis=0)
    for part in parts:
        # A device that is one between two stretches of vessel is none, or they are.
        if not part.any() or (part is not course and is_between(part, rest, half, pixel_mm)):
            continue
        even = part & (half <= WIDER * float(np.median(half[part])))
        more = found | skel.beside_alone(reach, line, even)
        # A picture of devices alone is for others to refuse.
        if (more & line).sum() <= DEVICE_SHARE * line.sum():
            found = more
    return found


def nominal_mm(picture: Image) -> float:
    """Return what a pixel is taken for where the network looks, whatever it is said to be, mm."""
    return NOMINAL_MM * SIDE / float(np.sqrt(picture.size))


def vessel_lines(probability: Image) -> tuple[Mask, Mask]:
    """(rows, cols) bool each: where a line is seen, and its centreline."""
    reach = skel.parts_touching(probability >= LEVELS[0], probability >= LEVELS[1])
    return reach, skel.prune(skel.skeletonize(reach), probability, SPUR_PX, 0.0)


def support(seen: Seen, levels: tuple[float, float]) -> Mask:
    """Where vessels are: hysteresis on the probability, without twigs and small parts.

    Parameters
    ----------
    seen : Seen, as the network says it
    levels : lower and upper one of the hysteresis

    Returns
    -------
    (rows, cols) bool, out to where a vessel fades
    """
    reach = skel.parts_touching(seen.probability >= levels[0], seen.probability >= levels[1])
    line = whole = skel.skeletonize(reach)
    if not line.any():
        return np.zeros_like(reach)
    deep = np.asarray(cv2.GaussianBlur(seen.chord, (0, 0), 0.7), dtype=np.float32)
    top = float(np.percentile(deep[line], 90))
    line = skel.prune(line, deep, SPUR_PX, TWIG_SHARE * top)
    if line.any():
        line = skel.strong_parts(line, deep, segment.PART_SHARE)
    return skel.beside(reach, whole, line) | skel.inscribed(reach, line)


def _with_contrast(near: Mask, chord: Image, contrast: Image, finer: float) -> Mask:
    """(rows, cols) bool: lines without those that nothing of the picture speaks for."""
    line = skel.skeletonize(near)
    if not line.any():
        return near
    _, (deep, rise) = skel.spread(line, (chord, contrast), _ALONG_PX * finer)
    return skel.beside(near, line, line & (rise >= CONTRAST_SHARE * deep))


def _drawn(path: Image, near: Mask, finer: float) -> Mask:
    """(rows, cols) bool: where the rims are, and no thinner than a line.

    ``finer``: pixels of the picture for one of the network.
    """
    line = skel.skeletonize(near)
    if not line.any():
        return line
    line = skel.prune(line, path, SPUR_PX * finer, 0.0)
    smooth = cv2.GaussianBlur(path, (0, 0), _BLUR_PX * max(1.0, finer))
    _, (peak,) = skel.spread(line, (smooth,), _ALONG_PX * finer)
    return ((smooth > RIM_SHARE * peak) | line) & near
