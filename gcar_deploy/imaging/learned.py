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
from gcar_deploy.imaging.net import Seen, Segmenter, at_network_size, net_input
from gcar_deploy.types import Image, Mask

#: hysteresis on the network's probability, for paths and for the mask: a path where there is none
#: costs less than one that is missing
PATH_LEVELS = (0.3, 0.6)
MASK_LEVELS = (0.5, 0.8)
#: a side branch shorter than this is a spur, pixels of the network
SPUR_PX = 12
#: an end of a branch shallower than this share of the main vessels is a twig
TWIG_SHARE = 0.15
#: hysteresis on the probability of a device, and how long one is at least, pixels of the network
DEVICE_LEVELS = (0.5, 0.8)
DEVICE_PX = 30


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
        The mask is where the network says vessel; its ``vesselness`` is the probability. Nothing
        of it depends on ``pixel_mm``.
    path_mm : (rows, cols) float32
        Length of the ray within vessel, 0 away from vessels; it reaches beyond the mask.
    """
    search = pictures.get("search", next(iter(pictures.values())))
    work, work_holes = at_network_size(search, holes)
    seen = segmenter.look(net_input(work, work_holes))
    seen = dataclasses.replace(
        seen, probability=np.where(work_holes, np.float32(0), seen.probability)
    )
    full = search.shape[::-1]
    work_mm = np.float32(pixel_mm * np.sqrt(search.size / work.size))
    reach = support(seen, PATH_LEVELS)
    near = (segment.resize(reach.astype(np.float32), full) >= 0.5) & ~holes
    sure = support(seen, MASK_LEVELS)
    around = cv2.dilate(sure.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(np.float32)
    probability = np.where(holes, np.float32(0), segment.resize(seen.probability, full))
    # The rim is where the answer crosses one half: between the network's own pixels.
    mask = (probability >= 0.5) & (segment.resize(around, full) >= 0.5)
    mask |= (segment.resize(sure.astype(np.float32), full) >= 0.5) & ~holes
    near |= mask
    chord = np.where(near, segment.resize(seen.chord, full) * work_mm, np.float32(0))
    laws = {name: picture for name, picture in pictures.items() if name != "search"}
    contrast = _scaled_contrast(laws, holes, near, chord, pixel_mm)
    device = _devices(seen, sure)
    found = dataclasses.replace(
        segment.given(search, mask, holes, pixel_mm),
        vesselness=probability,
        catheter=(segment.resize(device.astype(np.float32), full) >= 0.5) & ~mask,
        catheter_mm=int(skel.skeletonize(device).sum()) * float(work_mm),
    )
    return found, np.asarray(0.5 * (chord + contrast), dtype=np.float32)


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
    return skel.beside(reach, whole, line)


def _devices(seen: Seen, vessel: Mask) -> Mask:
    """(rows, cols) bool: catheters, leads and wires that are longer than a speck."""
    device = skel.parts_touching(seen.device >= DEVICE_LEVELS[0], seen.device >= DEVICE_LEVELS[1])
    device &= ~vessel
    _, label, stats, _ = cv2.connectedComponentsWithStats(device.astype(np.uint8))
    long = np.hypot(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]) >= DEVICE_PX
    long[0] = False
    return long[label]


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
