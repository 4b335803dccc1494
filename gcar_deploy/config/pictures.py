"""Options from a picture or DICOM run to vessels and path lengths."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Literal, TypeAlias, get_args

from gcar_deploy.config.ranges import Range, Size

SegmenterName: TypeAlias = Literal["auto", "classic", "net"]
SEGMENTERS = get_args(SegmenterName)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PictureLimits:
    """What a picture file may be before any decoder sees it."""

    max_bytes: Size = 32 * 2**20
    #: pixels; each side of the picture
    min_side: Size = 16
    max_side: Size = 4096


@dataclasses.dataclass(frozen=True, kw_only=True)
class DicomLimits(PictureLimits):
    """What a DICOM run may be before any of its pixels is decoded; sides are those of a frame."""

    max_bytes: Size = 512 * 2**20
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImagingOptions:
    """From a picture to vessel mask, skeleton and path length."""

    limits: PictureLimits = dataclasses.field(default_factory=PictureLimits)
    #: who finds vessels in grey values: the ridge filter, the network, or both (what either
    #: sees, or one alone where the views then agree better)
    segmenter: SegmenterName = "auto"
    #: take a picture of another size than its geometry's for a rescaled one: a crop of the same
    #: shape looks alike, and gives a tree of the wrong size
    allow_rescale: bool = False
