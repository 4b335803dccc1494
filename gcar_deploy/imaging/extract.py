"""One angiogram to one vessel image, for each kind of picture the contract knows."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from gcar_deploy.config import ImagingOptions
from gcar_deploy.errors import GeometryError, ModelError, RefusedError
from gcar_deploy.imaging import calibrate, enhance, even_ground, segment
from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.border import cut_out, put_back, shown_box
from gcar_deploy.imaging.coarse import as_fine, coarser
from gcar_deploy.imaging.edits import edited
from gcar_deploy.imaging.full_mask import refuse_full
from gcar_deploy.imaging.fusion import fused, without_device
from gcar_deploy.imaging.grey_values import bright_vessels
from gcar_deploy.imaging.learned import Found, learned_vessels
from gcar_deploy.imaging.mask_path import mask_path
from gcar_deploy.imaging.net import MISSING, Segmenter
from gcar_deploy.imaging.path_noise import vessels_in_noise
from gcar_deploy.imaging.polarity import is_dark, with_polarity
from gcar_deploy.imaging.shadow_devices import reaches_the_end, without_devices
from gcar_deploy.imaging.standing import what_came, without_standing
from gcar_deploy.imaging.thin_mask import refuse_thin
from gcar_deploy.imaging.widths import MASK_ERROR
from gcar_deploy.types import Image, Mask

_log = logging.getLogger(__name__)
#: what ``bright_vessels`` gives
_Grey: TypeAlias = tuple[dict[str, Image], Mask]
#: relative error of a path that was judged from contrast, and by the network
CONTRAST_ERROR, CHORD_ERROR = 0.25, 0.15
#: path-length pictures: vessel where the ray's mean path exceeds this share of a pixel's edge p.
#: A vessel of diameter D gives (pi/4) D^2 / p, so D >= 0.36 p is kept; less drowns in the sampling
#: of the picture itself
PATH_THRESHOLD_PIXELS = 0.1
#: less skeleton than this is no vessel; on an even ground nothing but vessel stands out, however
#: small the pixel is said to be
MIN_LENGTH_MM, EVEN_LENGTH_MM = 25.0, 10.0
#: nor is a weaker peak, in noise deviations; the network tells faint vessels from noise by shape
MIN_CONTRAST, NET_MIN_CONTRAST = 6.0, 3.0
#: and the peak, as a share of the white level, must be seen at all
MIN_PEAK = 0.03
#: vessels never fill more than this share of a picture
_FULL = 0.9


def extract_vessels(
    angiogram: Angiogram, options: ImagingOptions, segmenter: Segmenter | None = None
) -> VesselImage:
    """Find mask, skeleton and path length of the vessels.

    Parameters
    ----------
    angiogram : Angiogram
        ``path_length``: counts times ``mm_per_count``. ``attenuation``: linear in the path
        with unknown scale, vessels bright. ``raw``: vessels dark unless the polarity says
        otherwise or the picture clearly does; contrast against the filled-in background,
        scaled by the width of the vessels' shadows. ``mask``: vessel where above half of the
        largest value; paths from the vessels' width alone.
    options : ImagingOptions; ``segmenter`` says who finds vessels in grey values
    segmenter : the network, needed for ``net``; without it ``auto`` is ``classic``

    Returns
    -------
    VesselImage

    Raises
    ------
    RefusedError
        No vessel: blank, constant, saturated, nothing that stands out of the noise, or all of
        it erased.
    GeometryError
        ``path_length`` without ``mm_per_count``; it or ``mask`` declared dark.
    """
    (angiogram,) = with_polarity([angiogram])
    found = _found(angiogram, options, segmenter)
    if angiogram.bare and asks_network([angiogram]):
        found = without_standing(found, *_frames(angiogram), ~found.valid)
    return edited(found, angiogram)


def _found(
    angiogram: Angiogram, options: ImagingOptions, segmenter: Segmenter | None
) -> VesselImage:
    """Find vessels, whatever was drawn in the picture."""
    pixels = angiogram.pixels
    if not float(pixels.max()) > float(pixels.min()):
        raise _nothing(angiogram, f"every pixel is {float(pixels.flat[0]):g}")
    if angiogram.intensity.kind == "path_length":
        return _from_path_length(angiogram)
    if angiogram.intensity.kind == "mask":
        return _from_mask(angiogram)
    if angiogram.mask is not None:
        refuse_thin(angiogram, angiogram.mask)
        return _from_grey(angiogram, _under(_grey_values(angiogram), "display"), None)
    if options.segmenter == "net":
        segmenter = _needed(segmenter)
    # A gradient along one side has equal rows, as a border has: the whole picture is asked first.
    for box in dict.fromkeys(((0, pixels.shape[0], 0, pixels.shape[1]), shown_box(pixels))):
        part = cut_out(angiogram, box)
        grey = _grey_values(part)
        pixel_mm = part.carm.pixel_at_isocenter_mm
        drawn = even_ground.shadow(grey[0]["linear"], grey[1], pixel_mm)
        if drawn is not None:
            view = _from_shadow(part, grey, drawn, options, segmenter)
            return put_back(view, angiogram, box)
    small = coarser(part)
    grey = grey if small is part else _grey_values(small)
    # Beside anatomy, widths and chords tell the laws apart too badly to choose one.
    seen = _seen(small, _under(grey, "display"), options, segmenter)
    return put_back(as_fine(seen, part), angiogram, box)


def _under(grey: _Grey, *laws: str) -> _Grey:
    """Keep the pictures under these laws alone, and the one to look for vessels in."""
    return {name: p for name, p in grey[0].items() if name in ("search", "came", *laws)}, grey[1]


def _seen(
    angiogram: Angiogram, grey: _Grey, options: ImagingOptions, segmenter: Segmenter | None
) -> VesselImage:
    """Find vessels in grey values, by whom the options name."""
    if segmenter is None or options.segmenter == "classic":
        return _from_grey(angiogram, grey, None)
    if options.segmenter == "net":
        return _from_grey(angiogram, grey, segmenter)
    return _from_both(angiogram, grey, segmenter)


def asks_network(angiograms: Sequence[Angiogram]) -> bool:
    """Whether vessels have to be found in any of these: no path lengths, and no mask given."""
    return any(a.intensity.kind not in ("path_length", "mask") and a.mask is None
               for a in angiograms)  # fmt: skip


def asked_network(
    angiograms: Sequence[Angiogram], options: ImagingOptions, segmenter: Segmenter | None
) -> tuple[Segmenter | None, list[str]]:
    """Return the network if any of these is asked of it, and what there is to say if it misses."""
    if options.segmenter == "classic" or not asks_network(angiograms):
        return None, []
    return segmenter, [] if segmenter or options.segmenter == "net" else [MISSING]


def _from_both(angiogram: Angiogram, grey: _Grey, segmenter: Segmenter) -> VesselImage:
    """Fuse both methods; where one finds no vessel, the other has the say."""
    try:
        learned = _from_grey(angiogram, grey, segmenter)
    except RefusedError:
        return _from_grey(angiogram, grey, None)
    try:
        return fused(_from_grey(angiogram, grey, None), learned, grey[0]["display"])
    except RefusedError:
        return learned


def _from_shadow(
    angiogram: Angiogram, grey: _Grey, drawn: even_ground.Shadow, options: ImagingOptions,
    segmenter: Segmenter | None,
) -> VesselImage:  # fmt: skip
    """Vessels on an even ground, without what filter and network take for a catheter."""
    seen = dataclasses.replace(angiogram, mask=drawn.mask)
    shaded = drawn.shaded and "log" in grey[0]  # half of the light is half of the contrast
    grey = _under(grey, *(("log",) if shaded else ("linear", "log")))
    if drawn.flat:
        view = _from_drawn(seen, drawn.mask, EVEN_LENGTH_MM)
    else:
        view = _from_grey(seen, grey, None, EVEN_LENGTH_MM)
    pixel_mm = angiogram.carm.pixel_at_isocenter_mm
    if not reaches_the_end(drawn.mask, grey[1], pixel_mm):
        return view
    with contextlib.suppress(RefusedError):
        filtered, *_ = _lines(angiogram, grey, None)
        view = without_device(view, filtered.catheter, filtered.catheter_mm)
    if drawn.flat or segmenter is None or options.segmenter == "classic":
        return view
    search = enhance.searched(grey[0])
    return without_devices(view, search, grey[1], segmenter)


def _needed(segmenter: Segmenter | None) -> Segmenter:
    if segmenter is None:
        raise ModelError("segmenter net needs its model, which is not loaded")
    return segmenter


def _nothing(angiogram: Angiogram, reason: str) -> RefusedError:
    return RefusedError(
        f"no vessel found in {angiogram.label}: {reason}; "
        "check the picture and its intensity kind and polarity"
    )


def _from_path_length(angiogram: Angiogram) -> VesselImage:
    scale = angiogram.intensity.mm_per_count
    if scale is None:
        raise GeometryError(
            f"view {angiogram.view_id}: intensity kind path_length needs mm_per_count "
            "(millimetres of vessel per count)"
        )
    _refuse_dark(angiogram)
    path = np.asarray(angiogram.pixels * np.float32(scale), dtype=np.float32)
    smallest = PATH_THRESHOLD_PIXELS * angiogram.carm.pixel_at_isocenter_mm
    valid = np.ones(path.shape, bool) if angiogram.valid is None else angiogram.valid
    found = vessels_in_noise(path, valid, angiogram.carm.pixel_at_isocenter_mm, smallest)
    mask, noise = found or ((path > smallest) & valid, 0.0)
    if angiogram.mask is not None:
        mask &= angiogram.mask
    if not mask.any():
        raise _nothing(angiogram, f"no path is longer than {smallest:.2g} mm")
    if mask.mean() > _FULL:
        raise _nothing(angiogram, "nearly every pixel is full")
    return VesselImage(
        view_id=angiogram.view_id,
        carm=angiogram.carm,
        path_mm=np.where(mask, path, np.float32(0)),
        path_error=0.0,
        noise_mm=noise,
        enlarged=angiogram.enlarged,
        mask=mask,
        skeleton=skel.skeletonize(mask),
        valid=valid,
        kind="path_length",
    )


def _from_mask(angiogram: Angiogram) -> VesselImage:
    """Chords of round vessels: no brightness is read."""
    _refuse_dark(angiogram)
    valid = np.ones(angiogram.pixels.shape, bool) if angiogram.valid is None else angiogram.valid
    above = above_half(angiogram.pixels)
    refuse_full(angiogram, above)
    mask = above & valid
    if angiogram.mask is not None:
        mask &= angiogram.mask
    refuse_thin(angiogram, mask)
    return _from_drawn(dataclasses.replace(angiogram, valid=valid), mask)


def _from_drawn(angiogram: Angiogram, mask: Mask, least_mm: float = MIN_LENGTH_MM) -> VesselImage:
    line = skel.skeletonize(mask)
    pixel_mm = angiogram.carm.pixel_at_isocenter_mm
    length = float(skel.arc_length(line).sum()) * pixel_mm
    if length < least_mm:
        raise _nothing(angiogram, f"{length:.0f} mm of line (needed: {least_mm:g} mm)")
    return VesselImage(
        view_id=angiogram.view_id,
        carm=angiogram.carm,
        path_mm=mask_path(mask, pixel_mm),
        path_error=MASK_ERROR,
        mask=mask,
        skeleton=line,
        valid=np.ones(mask.shape, bool) if angiogram.valid is None else angiogram.valid,
        kind="mask",
    )


def above_half(pixels: Image) -> Mask:
    """Vessel of a picture that is a mask, binary or grey: above half of its largest value."""
    inside: Mask = pixels > 0.5 * float(pixels.max())
    return inside


def _refuse_dark(angiogram: Angiogram) -> None:
    kind = angiogram.intensity.kind
    if angiogram.intensity.polarity == "dark":
        raise GeometryError(
            f"{angiogram.label}: {kind} pictures have bright vessels, "
            "polarity dark contradicts that; use kind raw or invert the picture"
        )


def _grey_values(angiogram: Angiogram) -> _Grey:
    """Pictures with bright vessels, and where there is no picture; see ``bright_vessels``."""
    dark = is_dark(angiogram)
    pictures, holes = bright_vessels(angiogram.pixels, angiogram.intensity.kind, dark)
    if angiogram.valid is not None:
        holes = holes | ~angiogram.valid
    if angiogram.bare:
        pictures["came"] = what_came(*_frames(angiogram), holes)
    return pictures, holes


def _frames(angiogram: Angiogram) -> tuple[Image, list[Image]]:
    """Picture to look for vessels in, vessels bright, and the same of the bare frames."""
    kind, dark = angiogram.intensity.kind, is_dark(angiogram)
    frames = [bright_vessels(one, kind, dark)[0] for one in (angiogram.pixels, *angiogram.bare)]
    picture, *before = (next(iter(pictures.values())) for pictures in frames)
    return picture, before


def _lines(
    angiogram: Angiogram, grey: _Grey, segmenter: Segmenter | None, least_mm: float = MIN_LENGTH_MM
) -> tuple[segment.Segmentation, Image | None, Callable[[], Found] | None]:
    """Lines that are long and strong enough to be vessel; paths and ``kept`` of the network alone.

    Raises
    ------
    RefusedError
        Too short or too faint.
    """
    pixel_mm = angiogram.carm.pixel_at_isocenter_mm
    pictures, holes = grey
    search = enhance.searched(pictures)
    path_mm, kept = None, None
    if angiogram.mask is not None:
        found = segment.given(search, angiogram.mask & ~holes, holes, pixel_mm)
    elif segmenter is not None:
        (found, path_mm), kept = learned_vessels(pictures, holes, pixel_mm, segmenter)
    else:
        found = segment.segment(search, holes, pixel_mm, pictures.get("came"))
    if found.catheter_mm > 0:
        _log.info(
            "view %s: %.0f mm of line taken for a catheter and left out",
            angiogram.view_id, found.catheter_mm,
        )  # fmt: skip
    length = float(skel.arc_length(found.skeleton).sum()) * pixel_mm
    least = MIN_CONTRAST if segmenter is None else NET_MIN_CONTRAST
    too_faint = found.contrast < least or found.peak < MIN_PEAK
    too_faint &= angiogram.mask is None  # who draws a mask has seen the vessel
    if length < least_mm or too_faint:
        raise _nothing(
            angiogram,
            f"{length:.0f} mm of line, {found.peak:.1%} contrast, {found.contrast:.1f} times the "
            f"noise (needed: {least_mm:g} mm, {MIN_PEAK:.0%}, "
            f"{least:g} times)",
        )
    return found, path_mm, kept


def _from_grey(
    angiogram: Angiogram, grey: _Grey, segmenter: Segmenter | None,
    least_mm: float = MIN_LENGTH_MM,
) -> VesselImage:  # fmt: skip
    found, path_mm, kept = _lines(angiogram, grey, segmenter, least_mm)
    path_error = CHORD_ERROR
    if path_mm is None:
        path_mm = _contrast_path(angiogram, grey[0], found)
        path_error = CONTRAST_ERROR
    view = VesselImage(
        view_id=angiogram.view_id,
        carm=angiogram.carm,
        path_mm=path_mm,
        path_error=path_error,
        mask=found.mask,
        skeleton=found.skeleton,
        valid=found.valid,
        kind=angiogram.intensity.kind,
        vesselness=found.vesselness,
        catheter=found.catheter if angiogram.mask is None else None,
        catheter_mm=found.catheter_mm,
        device=found.device,
        by_network=segmenter is not None and angiogram.mask is None,
    )
    return view if kept is None else dataclasses.replace(view, kept=lambda: _whole(view, *kept()))


def _whole(view: VesselImage, found: segment.Segmentation, path_mm: Image) -> VesselImage:
    """Return the view with what was found where nothing is taken for a device."""
    return dataclasses.replace(
        view, path_mm=path_mm, mask=found.mask, skeleton=found.skeleton, catheter=None,
        catheter_mm=0.0,
    )  # fmt: skip


def _contrast_path(
    angiogram: Angiogram,
    pictures: dict[str, Image],
    found: segment.Segmentation,
) -> Image:
    """(rows, cols) float32, mm: contrast against the filled-in background, scaled by widths."""
    pixel_mm = angiogram.carm.pixel_at_isocenter_mm
    estimate = calibrate.estimate_path(
        {name: p for name, p in pictures.items() if name not in ("search", "came")},
        found,
        pixel_mm,
    )
    _log.info(
        "view %s: %s grey values, %.4g mm per unit, contrast/width spread %.2f",
        angiogram.view_id, estimate.domain, estimate.mm_per_unit, estimate.spread,
    )  # fmt: skip
    if estimate.mm_per_unit <= 0:
        raise _nothing(angiogram, "the lines found have no contrast")
    return estimate.path_mm
