"""Devices beside vessels on an even ground: nothing else stands there, so that they look like one.

Where vessels are is plain to see there; what is a catheter is asked of the network's two parts, as
in any other picture, along the lines that are seen.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.border import inward_px
from gcar_deploy.imaging.catheter import BORDER_MM
from gcar_deploy.imaging.device_lines import device_map
from gcar_deploy.imaging.even_ground import TOUCHING_PX
from gcar_deploy.imaging.fusion import without_lines
from gcar_deploy.imaging.learned import devices
from gcar_deploy.imaging.net import Segmenter, at_network_size, net_input
from gcar_deploy.imaging.resample import resize
from gcar_deploy.types import Image, Mask


def reaches_the_end(shadow: Mask, holes: Mask, pixel_mm: float) -> bool:
    """Whether something on an even ground reaches the end of the picture, as catheters do.

    It does so to the last pixel; where a picture fades into holes, to near them.
    """
    own = inward_px(np.ones_like(holes))
    left = inward_px(~holes)
    reaches = (own <= TOUCHING_PX) | ((left < own) & (left * pixel_mm <= BORDER_MM))
    return bool((shadow & reaches).any())


def without_devices(
    view: VesselImage, search: Image, holes: Mask, segmenter: Segmenter
) -> VesselImage:
    """Leave out what the network takes for a device among the lines of a view.

    Parameters
    ----------
    view : vessels on an even ground
    search : (rows, cols) float32, vessels bright, as ``net.net_input`` takes it
    holes : (rows, cols) bool, pixels without picture
    segmenter : Segmenter

    Returns
    -------
    VesselImage ; with ``device`` (what the network says of all lines) and, where some went,
    ``kept``. The view as it is where no line comes from the border: every catheter does.

    Raises
    ------
    ModelError, NumericalError, CancelledError
        As ``Segmenter.look``.
    """
    if not reaches_the_end(view.mask, holes, view.carm.pixel_at_isocenter_mm):
        return view
    pixel_mm = view.carm.pixel_at_isocenter_mm
    work, work_holes = at_network_size(search, holes)
    size = work.shape[::-1]
    line = skel.skeletonize(resize(view.skeleton.astype(np.float32), size) > 0)
    reach = (resize(view.mask.astype(np.float32), size) >= 0.5) | line
    channels = net_input(work, work_holes)
    told = device_map(segmenter, channels, segmenter.look(channels), line, reach, work_holes)
    device = devices(told, reach, line, work, work_holes)
    full = view.mask.shape[::-1]
    asked = dataclasses.replace(view, device=resize(told, full))
    if not device.any():
        return asked
    where = resize(device.astype(np.float32), full) >= 0.5
    left = without_lines(asked, where)
    if left.mask.sum() == view.mask.sum():
        return asked
    before = np.zeros_like(where) if view.catheter is None else view.catheter
    return dataclasses.replace(
        left,
        catheter=(before | where | view.mask) & ~left.mask,
        catheter_mm=view.catheter_mm + int((view.skeleton & where).sum()) * pixel_mm,
        kept=lambda: view,
    )
