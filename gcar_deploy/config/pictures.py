"""Options from a picture or DICOM run to vessels and path lengths."""

from __future__ import annotations

import dataclasses
from typing import Annotated

from gcar_deploy.config.ranges import Angle, Length, Range, Share, Size


@dataclasses.dataclass(frozen=True, kw_only=True)
class PictureLimits:
    """What a picture file may be before any decoder sees it."""

    max_bytes: Size = 32 * 2**20
    #: pixels; each side of the picture
    min_side: Size = 16
    max_side: Size = 4096


@dataclasses.dataclass(frozen=True, kw_only=True)
class DicomLimits:
    """What a DICOM run may be before any of its pixels is decoded."""

    max_bytes: Size = 512 * 2**20
    #: pixels; each side of a frame
    min_side: Size = 16
    max_side: Size = 4096
    max_frames: Size = 2000
    #: of all frames together
    max_pixels: Size = 2**30


@dataclasses.dataclass(frozen=True, kw_only=True)
class DicomOptions:
    """From a DICOM run to one picture with its geometry."""

    limits: DicomLimits = dataclasses.field(default_factory=DicomLimits)
    #: frame of each run, counted from 1, None to choose; one entry holds for all runs
    frames: Annotated[tuple[int | None, ...], Range(1, 1_000_000, many=1)] = (None,)
    #: for files that do not say it: pixel spacing at the detector, source to isocentre, mm
    pixel_spacing_mm: Annotated[float, Range(0.02, 10)] | None = None
    sod_mm: Annotated[float, Range(300, 5000)] | None = None
    #: frames filled to this share of the best are compared by their stillness
    filled_share: Share = 0.9
    #: a frame named by the file but filled less than this share of the best is worth a word
    least_filled_share: Share = 0.5
    #: tilt of the detector against the beam: said above the first, refused above the second
    good_tilt_deg: Angle = 0.1
    max_tilt_deg: Angle = 1.0
    #: share by which SDD / SOD may differ from the file's own magnification factor
    magnification_share: Share = 0.02


@dataclasses.dataclass(frozen=True, kw_only=True)
class CatheterOptions:
    """What counts as a catheter among the lines found. Millimetres at the isocentre."""

    #: False keeps every line
    reject: bool = True
    #: a catheter comes within this distance of the border of the field
    border_mm: Length = 3.0
    #: from the border to the tip; a side branch shorter than ``spur_mm`` is none
    shortest_mm: Length = 5.0
    longest_mm: Length = 80.0
    spur_mm: Length = 8.0
    #: width at half height, blur included (8 F are 2.7 mm), and its standard deviation along
    #: the catheter as a share of it
    widest_mm: Length = 4.2
    unevenness: Annotated[float, Range(0, 1e3)] = 0.06
    #: the vessel beyond the tip is this many times wider, its narrow places (lower 30 %) too
    step: Annotated[float, Range(0, 1e3)] = 1.5
    least_step: Annotated[float, Range(0, 1e3)] = 1.1
    #: and it is a main one: its width as a share of the 90th percentile of all
    vessel_share: Annotated[float, Range(0, 1e3)] = 0.6
    #: no vessel goes through the place where it ends: two arms at least this wide (share of the
    #: widest) and this straight
    arm_share: Annotated[float, Range(0, 1e3)] = 0.65
    through_deg: Angle = 150.0
    #: a line from border to border as long as this share of the picture's shorter side that
    #: stays close to its chord (90 % of it, as a share of the chord) is a lead or a wire
    crossing_share: Annotated[float, Range(1e-3, 10)] = 0.6
    crossing_off_share: Annotated[float, Range(0, 10)] = 0.025
    #: more of the line than this is never taken for catheters
    largest_share: Share = 0.25


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImagingOptions:
    """From a picture to vessel mask, skeleton and path length. Millimetres at the isocentre."""

    limits: PictureLimits = dataclasses.field(default_factory=PictureLimits)
    #: who finds vessels in grey values: ``classic``, ``net``, or ``auto`` (the mean of both, or
    #: the network alone where the views then agree better)
    segmenter: str = "auto"
    #: hysteresis on the network's probability, for paths and for the mask: a path where there is
    #: none costs less than one that is missing
    net_path: Annotated[tuple[float, float], Range(0, 1, many=2)] = (0.6, 0.9)
    net_mask: Annotated[tuple[float, float], Range(0, 1, many=2)] = (0.9, 0.98)
    #: an end of a branch shallower than this share of the main vessels is a twig
    net_twig_share: Share = 0.2
    #: rim of the network's mask, as a share of the path in the middle: what observers draw
    rim_share: Share = 0.65
    #: relative error of a path that was judged from contrast, and by the network
    contrast_error: Annotated[float, Range(0.01, 1)] = 0.25
    chord_error: Annotated[float, Range(0.01, 1)] = 0.15
    #: ... and from the width of a mask: its edges are off by a part of a pixel, a vessel seen at a
    #: slant is thicker than it is wide, and overlaps show one of two vessels
    mask_error: Annotated[float, Range(0.01, 1)] = 0.3
    #: path-length pictures: vessel where the ray's mean path exceeds this share of a pixel's
    #: edge p. A vessel of diameter D gives (pi/4) D^2 / p, so D >= 0.36 p is kept; less drowns
    #: in the sampling of the picture itself.
    path_threshold_pixels: Annotated[float, Range(0, 100)] = 0.1
    #: vessels are looked for at this pixel size (coarser pictures keep their own)
    work_pixel_mm: Annotated[float, Range(0.1, 10)] = 0.5
    #: Gaussian widths of the ridge filter: vessel diameters of some 1 to 7 mm
    ridge_sigma_mm: Annotated[tuple[float, ...], Range(0.1, 20, many=1)] = (0.75, 1.05, 1.5, 2.1)
    #: the ridge must stand above both sides at this many sigma (a step edge has only one)
    side_gap_sigmas: Annotated[float, Range(0, 20)] = 2.5
    #: response times sigma^power: below 0 a narrow explanation wins over a wide one
    scale_power: Annotated[float, Range(-10, 10)] = -0.5
    #: what varies more slowly than this is background to the ridge filter
    flatten_sigma_mm: Annotated[float, Range(0.1, 1000)] = 10.0
    #: grey level, as a share of the white level, added before the logarithm
    log_offset: Annotated[float, Range(1e-6, 1)] = 0.08
    #: hysteresis, as shares of the 99th percentile of the response
    low_share: Share = 0.3
    high_share: Share = 0.6
    #: connected parts with less than this share of the strongest part's summed response go
    part_share: Share = 0.08
    #: a side branch shorter than this is a spur; an end weaker than this share goes as well
    spur_mm: Length = 7.5
    weak_share: Share = 0.4
    #: a straight line as long as this share of the shorter side is a wire or an edge
    straight_share: Annotated[float, Range(1e-3, 10)] = 0.6
    catheter: CatheterOptions = dataclasses.field(default_factory=CatheterOptions)
    #: rim of the mask: this many noise deviations, but within these shares of the peak
    rim_noise: Annotated[float, Range(0, 1e6)] = 9.0
    rim_low: Share = 0.15
    rim_high: Share = 0.65
    #: the upper one is ``rim_high_in_grain`` where a blur of ``grain_mm`` leaves less than the
    #: first of these shares of the noise, and ``rim_high`` where it leaves more than the second
    rim_high_in_grain: Share = 0.45
    grain_mm: Annotated[float, Range(0.01, 100)] = 1.0
    grain_left: Annotated[tuple[float, float], Range(0, 1, many=2)] = (0.55, 0.65)
    #: farthest rim, in units of the ridge filter's sigma
    reach_sigmas: Annotated[float, Range(0.1, 20)] = 1.6
    #: filled-in background: margin left round the vessels, and width of the fill
    margin_mm: Annotated[float, Range(0, 100)] = 1.0
    fill_sigma_mm: Annotated[float, Range(0.1, 100)] = 2.5
    #: less skeleton than this, or a weaker peak in noise deviations, is no vessel
    min_length_mm: Length = 25.0
    min_contrast: Annotated[float, Range(0, 1e6)] = 6.0
    #: the network tells faint vessels from noise by their shape
    net_min_contrast: Annotated[float, Range(0, 1e6)] = 3.0
    #: and the peak, as a share of the white level, must be seen at all
    min_peak: Share = 0.03
