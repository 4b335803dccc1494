"""Vessels of a picture as the network sees them: mask, skeleton and path lengths.

The network says where vessels are and how deep they look: that holds in clutter, but is as coarse
as its input. The contrast against what surrounds the vessels is fine, but of unknown scale and
full of whatever else is there. So the network's support and chords give the contrast its scale,
and the path length is the mean of both.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import cv2
import numpy as np

from gcar_deploy.imaging import enhance, segment
from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.catheter import catheters
from gcar_deploy.imaging.net import Segmenter, net_input
from gcar_deploy.types import Image, Mask

#: hysteresis on the network's probability, for paths and for the mask: a path where there is none
#: costs less than one that is missing
PATH_LEVELS = (0.6, 0.9)
MASK_LEVELS = (0.9, 0.98)
#: an end of a branch shallower than this share of the main vessels is a twig
TWIG_SHARE = 0.2
#: rim of the mask, as a share of the path in the middle: what observers draw
RIM_SHARE = 0.65
#: paths are averaged over so much of the line before they say where the rim is, mm
_SMOOTH_MM = 1.5


def learned_vessels(
    pictures: Mapping[str, Image],
    holes: Mask,
    pixel_mm: float,
    segmenter: Segmenter,
) -> tuple[segment.Segmentation, Image]:
    """Find bright vessels and how deep they are.

    Parameters
    ----------
    pictures : name -> (rows, cols) float32, vessels bright
        ``search`` is what the network sees (the first where there is none), the others are linear
        in the path if their law of grey values holds.
    holes : (rows, cols) bool, pixels without picture (collimator)
    pixel_mm : float, pixel size at the isocentre
    segmenter : Segmenter

    Returns
    -------
    found : Segmentation, at the picture's own size
        The mask ends where an observer sees the rim, at a share of the path in the middle; its
        ``vesselness`` is the network's probability.
    path_mm : (rows, cols) float32
        Length of the ray within vessel, 0 away from vessels; it reaches beyond the mask.
    """
    search = pictures.get("search", next(iter(pictures.values())))
    work, work_holes, work_mm = segment.at_working_size(search, holes, pixel_mm)
    seen = segmenter.look(net_input(work, work_holes, work_mm))
    full = search.shape[::-1]
    probability = np.where(work_holes, np.float32(0), seen.probability)
    reach = support(probability, seen.chord, work_mm, PATH_LEVELS)
    reach, device = _without_catheters(reach, work, work_holes, work_mm)
    near = (segment.resize(reach.astype(np.float32), full) >= 0.5) & ~holes
    sure = support(probability, seen.chord, work_mm, MASK_LEVELS) & reach
    chord = np.where(near, segment.resize(seen.chord, full) * np.float32(work_mm), np.float32(0))
    laws = {name: picture for name, picture in pictures.items() if name != "search"}
    contrast = _scaled_contrast(laws, holes, near, chord, pixel_mm)
    path = np.asarray(0.5 * (chord + contrast), dtype=np.float32)
    surely = (segment.resize(sure.astype(np.float32), full) >= 0.5) & near
    mask = _drawn(path, surely, pixel_mm)
    found = dataclasses.replace(
        segment.given(search, mask, holes, pixel_mm),
        vesselness=np.where(holes, np.float32(0), segment.resize(seen.probability, full)),
        catheter=(segment.resize(device.astype(np.float32), full) >= 0.5) & ~near,
        catheter_mm=int(skel.skeletonize(device).sum()) * work_mm,
    )
    return found, path


def support(
    probability: Image,
    chord: Image,
    pixel_mm: float,
    levels: tuple[float, float],
) -> Mask:
    """Where vessels are: hysteresis on the probability, without twigs and small parts.

    Parameters
    ----------
    probability, chord : (rows, cols) float32, as the network says them
    pixel_mm : float
    levels : lower and upper one of the hysteresis

    Returns
    -------
    (rows, cols) bool, out to where a vessel fades
    """
    reach = skel.parts_touching(probability >= levels[0], probability >= levels[1])
    line = whole = skel.skeletonize(reach)
    if not line.any():
        return np.zeros_like(reach)
    deep = np.asarray(cv2.GaussianBlur(chord, (0, 0), 0.7), dtype=np.float32)
    top = float(np.percentile(deep[line], 90))
    line = skel.prune(line, deep, segment.SPUR_MM / pixel_mm, TWIG_SHARE * top)
    if line.any():
        line = skel.strong_parts(line, deep, segment.PART_SHARE)
    return skel.beside(reach, whole, line)


def _without_catheters(reach: Mask, work: Image, holes: Mask, pixel_mm: float) -> tuple[Mask, Mask]:
    """(rows, cols) bool each: what stays vessel, and what is taken for a catheter."""
    line = skel.skeletonize(reach)
    taken = np.zeros_like(reach)
    if line.any():
        flat = enhance.flatten(work, enhance.FLATTEN_SIGMA_MM / pixel_mm)
        width = enhance.ridges(flat, pixel_mm).sigma_px
        taken = catheters(line, flat, width, ~holes, pixel_mm)
    if not taken.any():
        return reach, taken
    kept = skel.beside(reach, line, line & ~taken)
    return kept, reach & ~kept


def _scaled_contrast(
    laws: Mapping[str, Image],
    holes: Mask,
    near: Mask,
    chord: Image,
    pixel_mm: float,
) -> Image:
    """(rows, cols) float32, mm: contrast under the law that agrees best with the chords."""
    best, agreement = np.zeros_like(chord), -np.inf
    if not near.any():
        return best
    for picture in laws.values():
        filled = enhance.fill_holes(picture, holes)
        rise = np.clip(filled - enhance.background(filled, near, pixel_mm), 0, None)
        c, q = rise[near].astype(np.float64), chord[near].astype(np.float64)
        if not c.any() or not q.any():
            continue
        alike = float((c * q).sum() / np.sqrt((c * c).sum() * (q * q).sum()))
        if alike > agreement:
            scale = np.float32((c * q).sum() / (c * c).sum())
            best, agreement = np.where(near, rise * scale, np.float32(0)), alike
    return best if agreement > -np.inf else chord


def _drawn(path: Image, near: Mask, pixel_mm: float) -> Mask:
    """(rows, cols) bool: where an observer would draw the rims, and no thinner than a line."""
    line = skel.skeletonize(near)
    if not line.any():
        return line
    line = skel.prune(line, path, segment.SPUR_MM / pixel_mm, 0.0)
    smooth = cv2.GaussianBlur(path, (0, 0), max(0.7, 0.35 / pixel_mm))
    _, (peak,) = skel.spread(line, (smooth,), _SMOOTH_MM / pixel_mm)
    return ((smooth > RIM_SHARE * peak) | line) & near
