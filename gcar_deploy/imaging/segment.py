"""From ridge response to vessel mask and skeleton."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from gcar_deploy.imaging import enhance
from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.catheter import catheters
from gcar_deploy.imaging.resample import blocks, resize
from gcar_deploy.types import Array, Image, Mask

#: vessels are looked for at this pixel size (coarser pictures keep their own)
WORK_PIXEL_MM = 0.5
#: noise is that of these pixels, blurred by so much
NOISE_BLUR_PX = 0.8
#: hysteresis, as shares of the 99th percentile of the response
LOW_SHARE, HIGH_SHARE = 0.3, 0.6
#: the upper one is at least so many times what the grain of that part of the picture answers, by
#: blocks of so many mm. Chosen on generated pictures; 6 loses vessels of real ones
HIGH_GRAIN, GRAIN_BLOCK_MM = 5.0, 15.0
#: connected parts with less than this share of the strongest part's summed response go
PART_SHARE = 0.08
#: a side branch shorter than this is a spur; an end weaker than this share goes as well
SPUR_MM = 7.5
WEAK_SHARE = 0.4
#: a straight line as long as this share of the shorter side is a wire or an edge
STRAIGHT_SHARE = 0.6
#: rim of the mask: this many noise deviations, but within these shares of the peak
RIM_NOISE = 9.0
RIM_LOW, RIM_HIGH = 0.15, 0.65
#: the upper one is lower where a blur of ``GRAIN_MM`` leaves less than the first of these shares
#: of the noise, and ``RIM_HIGH`` where it leaves more than the second
RIM_HIGH_IN_GRAIN = 0.45
GRAIN_MM = 1.0
GRAIN_LEFT = (0.55, 0.65)
#: farthest rim, in units of the ridge filter's sigma
REACH_SIGMAS = 1.6


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Segmentation:
    """Vessels of one picture, at the picture's own size.

    Attributes
    ----------
    mask, skeleton, valid : (rows, cols) bool
    vesselness : (rows, cols) float32, units of the picture
    peak : float
        Mean rise of the skeleton above the background, units of the picture.
    contrast : float
        ``peak`` over the noise beside the vessels. Both are 0 where nothing was found.
    catheter : (rows, cols) bool
        Lines taken for catheters, as wide as they look; no part of the mask.
    catheter_mm : float
        Their length.
    device : (rows, cols) float32 or None
        Probability of catheter, lead or wire; None where no network was asked.
    """

    mask: Mask
    skeleton: Mask
    valid: Mask
    vesselness: Image
    peak: float
    contrast: float
    catheter: Mask
    catheter_mm: float
    device: Image | None = None


def segment(
    picture: Image,
    holes: Mask,
    pixel_mm: float,
    came: Image | None = None,
) -> Segmentation:
    """Find bright vessels.

    The search runs at ``WORK_PIXEL_MM``, since vessels have a known size in mm; only
    the rim of the mask is drawn in the picture's own pixels.

    Parameters
    ----------
    picture : (rows, cols) float32, vessels bright
    holes : (rows, cols) bool, pixels without picture (collimator)
    pixel_mm : float, pixel size at the isocentre
    came : (rows, cols) float32, 1 where contrast came since the run began; None: nobody knows
    """
    rows, columns = picture.shape
    work, work_holes, work_mm = at_working_size(picture, holes, pixel_mm)
    flat = enhance.flatten(work, enhance.FLATTEN_SIGMA_MM / work_mm)
    found = enhance.ridges(flat, work_mm)
    response = np.where(work_holes, np.float32(0), found.response)
    line = centreline(response, ~work_holes, work_mm)
    taken = catheters(line, flat, found.sigma_px, ~work_holes, work_mm)
    if came is not None:
        taken &= ~skel.mostly(taken, resize(came, work.shape[::-1]) > 0.5)
    if taken.any():
        line = skel.strong_parts(line & ~taken, response, PART_SHARE)
    device = _drawn_lines(taken, found.sigma_px)
    full = (columns, rows)
    vesselness = np.where(holes, np.float32(0), resize(response, full))
    if not line.any():
        nothing = np.zeros((rows, columns), bool)
        return Segmentation(
            mask=nothing, skeleton=nothing, valid=~holes, vesselness=vesselness,
            peak=0.0, contrast=0.0, catheter=nothing, catheter_mm=0.0,
        )  # fmt: skip
    rim = _rim(work, flat, line, device, found.sigma_px, work_mm)
    mask = _draw(picture, holes, line, rim, pixel_mm)
    return Segmentation(
        mask=mask,
        skeleton=skel.skeletonize(mask),
        valid=~holes,
        vesselness=vesselness,
        peak=rim.peak,
        contrast=rim.contrast,
        catheter=(resize(device.astype(np.float32), full) > 0.5) & ~mask,
        catheter_mm=int(taken.sum()) * work_mm,
    )


def at_working_size(picture: Image, holes: Mask, pixel_mm: float) -> tuple[Image, Mask, float]:
    """Return picture, holes and pixel size for the search; coarser pictures keep their own."""
    size = _working_size(picture, pixel_mm)
    work = resize(enhance.fill_holes(picture, holes), size)
    work_holes = resize(holes.astype(np.float32), size) > 0.1
    return work, work_holes, pixel_mm * picture.shape[1] / size[0]


def _working_size(picture: Image, pixel_mm: float) -> tuple[int, int]:
    """Columns and rows of the search."""
    rows, columns = picture.shape
    scale = min(1.0, pixel_mm / WORK_PIXEL_MM)
    return max(16, round(columns * scale)), max(16, round(rows * scale))


def centreline(response: Image, valid: Mask, pixel_mm: float) -> Mask:
    """(rows, cols) bool: hysteresis, small parts, straight wires, spurs and weak ends."""
    if not valid.any():
        return np.zeros_like(valid)
    top = float(np.percentile(response[valid], 99))
    if top <= 0:
        return np.zeros_like(valid)
    grain = _grain(response, valid, pixel_mm)
    strong = response > np.maximum(HIGH_SHARE * top, HIGH_GRAIN * grain)
    line = skel.skeletonize(skel.parts_touching(response > LOW_SHARE * top, strong))
    line = skel.strong_parts(line, response, PART_SHARE)
    line = _without_wires(line)
    line = skel.prune(line, response, SPUR_MM / pixel_mm, WEAK_SHARE * top)
    if not line.any():
        return line
    return skel.strong_parts(line, response, PART_SHARE)


def _grain(response: Image, valid: Mask, pixel_mm: float) -> Image:
    """(rows, cols) float32, what the filter answers to the grain round each place.

    Grain answers everywhere, vessels in little of a block: its median is of the grain. A logarithm
    makes more of it where the picture is dark. Of white noise, blurred or not, one answer in a
    hundred is 3 to 4 times as strong as the median.
    """
    side = GRAIN_BLOCK_MM / pixel_mm
    rows, columns = (max(1, round(n / side)) for n in response.shape)
    answers = np.where(valid & (response > 0), response, np.nan)
    found = [
        np.median(some) if len(some := block[np.isfinite(block)]) else 0.0
        for block in blocks(answers, rows, columns)
    ]
    return resize(np.array(found, np.float32).reshape(rows, columns), response.shape[::-1])


def given(picture: Image, mask: Mask, holes: Mask, pixel_mm: float) -> Segmentation:
    """Take the user's mask as it is; only contrast and noise are measured.

    Parameters
    ----------
    picture : (rows, cols) float32, vessels bright
    mask, holes : (rows, cols) bool
    pixel_mm : float, pixel size at the isocentre
    """
    line = skel.skeletonize(mask)
    filled = enhance.fill_holes(picture, holes)
    rise = filled - enhance.background(filled, mask, pixel_mm)
    peak = float(rise[line].mean()) if line.any() else 0.0
    # Fine pixels have more noise, and show a vessel no worse.
    size = _working_size(picture, pixel_mm)
    coarse = cv2.GaussianBlur(resize(rise, size), (0, 0), NOISE_BLUR_PX)
    noise = _noise_beside(coarse, resize(mask.astype(np.float32), size) > 0)
    return Segmentation(
        mask=mask,
        skeleton=line,
        valid=~holes,
        vesselness=np.where(mask, np.clip(rise, 0, None), np.float32(0)),
        peak=peak,
        contrast=peak / max(noise, 1e-12) if line.any() else 0.0,
        catheter=np.zeros_like(mask),
        catheter_mm=0.0,
    )


def _without_wires(line: Mask) -> Mask:
    """Cut straight lines longer than any vessel runs straight: wires, sternum, shutter edges."""
    length = STRAIGHT_SHARE * min(line.shape)
    wires = cv2.HoughLinesP(
        line.astype(np.uint8), 1, np.pi / 360, threshold=int(0.5 * length),
        minLineLength=length, maxLineGap=0.03 * length,
    )  # fmt: skip
    if wires is None:
        return line
    drawn = np.zeros(line.shape, np.uint8)
    for x0, y0, x1, y1 in wires.reshape(-1, 4):
        # A wire goes on beyond the stretch that was found.
        dx, dy = (x1 - x0) // 2, (y1 - y0) // 2
        cv2.line(drawn, (int(x0 - dx), int(y0 - dy)), (int(x1 + dx), int(y1 + dy)), 1, 7)
    return line & (drawn == 0)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Rim:
    """The mask is where the picture exceeds ``ground + level`` and ``room`` is positive."""

    ground: Image
    level: Image
    room: Image
    peak: float
    contrast: float


def _drawn_lines(line: Mask, sigma_px: Image) -> Mask:
    """Lines at the width where the ridge filter answered most."""
    if not line.any():
        return line
    distance, (sigma,) = skel.spread(line, (sigma_px,), 3.0)
    return distance <= 1.0 + sigma


def _rim(
    work: Image,
    flat: Image,
    line: Mask,
    device: Mask,
    sigma_px: Image,
    pixel_mm: float,
) -> _Rim:
    """Set the rim's level between noise and peak.

    A chord through a round vessel is 2 sqrt(R^2 - x^2): the rim lies at level 0, and only
    noise forbids to look for it there. So the level is a multiple of the noise, bounded on
    both sides by shares of the peak.
    """
    distance, (sigma,) = skel.spread(line, (sigma_px,), 3.0)
    room = REACH_SIGMAS * sigma + 1.0 - distance
    # First the whole reach counts as vessel, then what the first rim encloses.
    grown = room > 0
    for _ in range(2):
        # A catheter is no vessel, but no background either.
        ground = enhance.background(flat, grown | device, pixel_mm)
        rise = cv2.GaussianBlur(flat - ground, (0, 0), NOISE_BLUR_PX)
        noise = _noise_beside(rise, grown | device)
        _, (peak,) = skel.spread(line, (rise,), 3.0)
        peak = np.maximum(peak, 1e-12)
        high = _highest_rim(rise, grown | device, noise, pixel_mm)
        level = np.clip(RIM_NOISE * noise, RIM_LOW * peak, high * peak)
        grown = ((rise > level) & (room > 0)) | line
    return _Rim(
        ground=work - flat + ground,
        level=level,
        room=room,
        peak=float(peak[line].mean()),
        contrast=float(peak[line].mean() / max(noise, 1e-12)),
    )


def _highest_rim(rise: Array, found: Mask, noise: float, pixel_mm: float) -> float:
    """Highest level of the rim as a share of the peak, by what the noise is made of.

    Structure of the background passes for vessel if the rim is low; fine grain only makes the
    rim ragged. What a blur leaves of the noise is structure.
    """
    blurred = cv2.GaussianBlur(rise, (0, 0), max(0.5, GRAIN_MM / pixel_mm))
    left = _noise_beside(blurred, found) / max(noise, 1e-12)
    return float(np.interp(left, GRAIN_LEFT, (RIM_HIGH_IN_GRAIN, RIM_HIGH)))


def _noise_beside(rise: Array, vessel: Mask) -> float:
    grown = vessel.astype(np.uint8)
    close = cv2.dilate(grown, np.ones((7, 7), np.uint8)) > 0
    around = (cv2.dilate(grown, np.ones((31, 31), np.uint8)) > 0) & ~close
    if not around.any():
        return 0.0
    return 1.4826 * float(np.median(np.abs(rise[around])))


def _draw(picture: Image, holes: Mask, line: Mask, rim: _Rim, pixel_mm: float) -> Mask:
    """Draw the rim in the picture's own pixels from the coarse level, limit and background."""
    full = picture.shape[::-1]
    blur = 0.8 * picture.shape[1] / line.shape[1]
    fine = cv2.GaussianBlur(enhance.fill_holes(picture, holes), (0, 0), blur)
    inside = (fine - resize(rim.ground, full) > resize(rim.level, full)) & ~holes
    inside &= resize(rim.room, full) > 0
    seeds = cv2.resize(line.astype(np.uint8), full, interpolation=cv2.INTER_NEAREST) > 0
    inside |= seeds & ~holes
    return _fill_specks(skel.parts_touching(inside, seeds & ~holes), 1.0 / pixel_mm**2)


def _fill_specks(mask: Mask, largest_px: float) -> Mask:
    """Fill enclosed holes smaller than a vessel: each would be a loop of the skeleton."""
    _, label, stats, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] <= largest_px
    small[0] = False
    return mask | small[label]
