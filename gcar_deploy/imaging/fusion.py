"""What the classical method and the network see of one picture, as one vessel image."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.contrast import scaled_contrast
from gcar_deploy.imaging.one_sided import one_sided
from gcar_deploy.types import Image, Mask

#: a line of the classical method's alone is one where the network finds it as probable as this, in
#: the mean and in the middle: others are edges of ribs and clouds but for one in a hundred or so.
#: Chosen on generated raw pairs of three simulators
_LEAST_MEAN, _LEAST_MEDIAN = 0.1, 0.02
#: a line of the network's is on a device that lies so near, pixels each way
_NEAR = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))


def fused(classic: VesselImage, learned: VesselImage, picture: Image) -> VesselImage:
    """Read paths where the network sees a vessel, or the other one and the network not surely none.

    Their errors have little in common: the one follows any line, however faint; the other knows
    what a vessel looks like, at whatever size. The mask is what the network draws. Contrast is the
    same for both, on the scale of the network's paths. A catheter has the contrast of a vessel, so
    that either method takes many for one: what one of them knows for a catheter leaves both.

    Parameters
    ----------
    classic, learned : of the same picture
    picture : (rows, cols) float32, that picture about linear in the path, vessels bright

    Returns
    -------
    VesselImage ; its ``others`` are ``learned`` and ``classic``, and where these hold lines that
    stand out on one side alone, all three without them
    """
    kept, whole = learned.kept, classic
    classic, learned = (
        without_lines(classic, learned.catheter),
        without_lines(learned, classic.catheter),
    )
    classic = dataclasses.replace(classic, device=learned.device)
    others: tuple[VesselImage, ...] = (learned, classic)
    rims = one_sided(
        [(view.skeleton, view.path_mm > 0) for view in others], picture, ~learned.valid,
        learned.carm.pixel_at_isocenter_mm,
    )  # fmt: skip
    less = tuple(without_lines(view, rim) for view, rim in zip(others, rims, strict=True))
    if any(a is not b for a, b in zip(less, others, strict=True)):
        others += (_both(less[1], less[0], picture), *less)
    return dataclasses.replace(
        _both(classic, learned, picture), others=others,
        kept=None if kept is None else lambda: _both(whole, kept(), picture),
    )  # fmt: skip


def _both(classic: VesselImage, learned: VesselImage, picture: Image) -> VesselImage:
    either = _likely(classic, learned) | (learned.path_mm > 0)
    return dataclasses.replace(
        learned,
        path_mm=scaled_contrast(
            picture, ~learned.valid, either, np.where(learned.mask, learned.path_mm, 0),
            learned.carm.pixel_at_isocenter_mm,
        ),
        catheter=_either(classic, learned, learned.mask),
        catheter_mm=max(classic.catheter_mm, learned.catheter_mm),
    )  # fmt: skip


def _likely(classic: VesselImage, learned: VesselImage) -> Mask:
    """Where the classical method sees vessel, without lines that are none for the network."""
    reach = classic.path_mm > 0
    line = skel.skeletonize(reach)
    alone = line & (cv2.dilate((learned.path_mm > 0).astype(np.uint8), _NEAR) == 0)
    seen = learned.vesselness
    if seen is None or not alone.any():
        return reach
    count, label = cv2.connectedComponents(alone.astype(np.uint8), connectivity=8)
    probability, number = cv2.dilate(seen, _NEAR)[alone], label[alone]
    doubted = np.zeros(count, bool)
    for k in range(1, count):
        own = probability[number == k]
        doubted[k] = own.mean() < _LEAST_MEAN or np.median(own) < _LEAST_MEDIAN
    return reach & ~skel.beside_alone(reach, line, doubted[label])


def without_lines(view: VesselImage, device: Mask | None) -> VesselImage:
    """Cut the lines that lie on a device, as wide as they are."""
    if device is None or not device.any():
        return view
    line = view.skeleton
    on_it = line & (cv2.dilate(device.astype(np.uint8), _NEAR) > 0)
    left = line & ~on_it
    if not on_it.any() or not left.any():
        return view
    gone = skel.beside_alone(view.path_mm > 0, line, on_it)
    mask = skel.parts_touching(view.mask & ~gone, left)
    return dataclasses.replace(
        view,
        mask=mask,
        skeleton=skel.skeletonize(mask),
        path_mm=np.where(gone, np.float32(0), view.path_mm),
    )


def without_device(view: VesselImage, device: Mask | None, length_mm: float) -> VesselImage:
    """Cut the lines that lie on a device, and say where it is and how long."""
    left = without_lines(view, device)
    if device is None:
        return left
    return dataclasses.replace(left, catheter=device & ~left.mask, catheter_mm=length_mm)


def _either(classic: VesselImage, learned: VesselImage, mask: Mask) -> Mask:
    found = [view.catheter for view in (classic, learned) if view.catheter is not None]
    return np.logical_or.reduce([np.zeros_like(mask), *found]) & ~mask
