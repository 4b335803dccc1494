"""Options of every stage as frozen values; each default is written here and nowhere else."""

from __future__ import annotations

import dataclasses
from typing import TypeAlias

from gcar_deploy.config.pictures import (
    SEGMENTERS,
    DicomLimits,
    DicomOptions,
    ImagingOptions,
    PictureLimits,
    SegmenterName,
)
from gcar_deploy.config.pose import PoseOptions
from gcar_deploy.config.predict import (
    PREDICTORS,
    CandidateOptions,
    ModelLimits,
    PredictOptions,
    PredictorName,
)
from gcar_deploy.config.quality import QualityOptions
from gcar_deploy.config.ranges import check_options
from gcar_deploy.config.refine import (
    BACKENDS,
    DEVICES,
    PRINTED,
    REFINERS,
    RELEASED,
    Backend,
    PaperOptions,
    RefineOptions,
    RefinerName,
    TubeOptions,
)

__all__ = [
    "BACKENDS",
    "DEVICES",
    "PREDICTORS",
    "PRINTED",
    "REFINERS",
    "RELEASED",
    "SEGMENTERS",
    "Backend",
    "CandidateOptions",
    "DicomLimits",
    "DicomOptions",
    "ImagingOptions",
    "Landmark",
    "LesionBorders",
    "ModelLimits",
    "PaperOptions",
    "PictureLimits",
    "PoseOptions",
    "PredictOptions",
    "PredictorName",
    "QualityOptions",
    "RefineOptions",
    "RefinerName",
    "RunOptions",
    "SegmenterName",
    "TubeOptions",
    "check_options",
]

#: (col, row) of one point in each view, None where it is not seen
Landmark: TypeAlias = tuple[tuple[float, float] | None, ...]


@dataclasses.dataclass(frozen=True, kw_only=True)
class LesionBorders:
    """Borders of one lesion: number of the view from 1, (col, row) of both ends in it."""

    view: int
    proximal: tuple[float, float]
    distal: tuple[float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Everything ``reconstruct`` needs to know beside pictures and geometry."""

    dicom: DicomOptions = dataclasses.field(default_factory=DicomOptions)
    imaging: ImagingOptions = dataclasses.field(default_factory=ImagingOptions)
    pose: PoseOptions = dataclasses.field(default_factory=PoseOptions)
    candidates: CandidateOptions = dataclasses.field(default_factory=CandidateOptions)
    predict: PredictOptions = dataclasses.field(default_factory=PredictOptions)
    refine: RefineOptions = dataclasses.field(default_factory=RefineOptions)
    quality: QualityOptions = dataclasses.field(default_factory=QualityOptions)
    #: points marked in the pictures, which hold the views to each other
    landmarks: tuple[Landmark, ...] = ()
    #: a place on one vessel in each of two views or more, not the same place of it
    same_branch: tuple[Landmark, ...] = ()
    #: where arteries begin, marked in two views or more
    ostia: tuple[Landmark, ...] = ()
    #: a place on each branch that is to go, mm LPS, in the order of deletion
    deleted_mm: tuple[tuple[float, float, float], ...] = ()
    #: borders of lesions marked in a picture, beside those that are found
    lesions: tuple[LesionBorders, ...] = ()
