"""DICOM XA runs: bytes, lengths and attributes of small files; header, frame and geometry."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

# Without pydicom there is nothing to damage, and the kind is skipped.
import pydicom
from pydicom.dataset import Dataset

from gcar_deploy.config import DicomOptions
from gcar_deploy.dicom.scene import read_run, read_views
from tests.battery.damage import EDGES, damaged
from tests.battery.kinds.common import generator, outcome
from tests.battery.pool import Case, FoundError
from tests.dicom.files import as_bytes, classic, enhanced, vessel_frames

_KEYWORDS = (
    "Rows", "Columns", "NumberOfFrames", "BitsAllocated", "BitsStored", "HighBit",
    "PixelRepresentation", "SamplesPerPixel", "PhotometricInterpretation", "ImagerPixelSpacing",
    "PositionerPrimaryAngle", "PositionerSecondaryAngle", "PositionerPrimaryAngleIncrement",
    "DistanceSourceToDetector", "DistanceSourceToPatient", "FrameTime", "FrameTimeVector",
    "RepresentativeFrameNumber", "ShutterShape", "ShutterPresentationValue", "PixelData",
    "PixelIntensityRelationship", "EstimatedRadiographicMagnificationFactor",
)  # fmt: skip


def make(seed: int) -> Case:
    """Return the fuzz case of DICOM runs."""
    groups = {
        "PositionerPositionSequence": {"PositionerPrimaryAngle": 10.0},
        "XRayGeometrySequence": {"DistanceSourceToIsocenter": 765.0},
    }
    originals = [
        as_bytes(classic()),
        as_bytes(classic(vessel_frames(4, 2))),
        as_bytes(enhanced(vessel_frames(2), [{}, {}], groups)),
    ]

    def case(index: int, folder: Path) -> str:
        rng = generator("dicom", seed, index)
        data = rng.choice(originals)
        if rng.random() < 0.5:
            data = _other_values(data, rng)
        if rng.random() < 0.6:
            # Past the preamble, where every byte means something.
            head = 132 if rng.random() < 0.9 else 0
            data = data[:head] + damaged(data[head:2200], rng) + data[2200:]
        if rng.random() < 0.1:
            at = rng.randrange(len(data))
            data = data[:at] + struct.pack("<I", 0xFFFFFFFF) + data[at + 4 :]
        path = folder / "run.dcm"
        path.write_bytes(data)
        return outcome(folder, (2, 3, 4), lambda: _read(path))

    return case


def _other_values(data: bytes, rng) -> bytes:
    dataset = pydicom.dcmread(pydicom.filebase.DicomBytesIO(data))
    for _ in range(rng.randint(1, 3)):
        keyword, value = rng.choice(_KEYWORDS), rng.choice(EDGES)
        try:
            if rng.random() < 0.2:
                delattr(dataset, keyword)
            else:
                setattr(dataset, keyword, value)
            changed = as_bytes(dataset)
        except Exception:  # noqa: BLE001 - the library will not write such a value: no case
            dataset = pydicom.dcmread(pydicom.filebase.DicomBytesIO(data))
            continue
        data = changed
    if rng.random() < 0.05:
        deep = Dataset()
        for _ in range(200):
            outer = Dataset()
            outer.RequestAttributesSequence = [deep]
            deep = outer
        dataset.RequestAttributesSequence = [deep]
        data = as_bytes(dataset)
    return data


def _read(path: Path) -> str:
    options = DicomOptions()
    run = read_run(path, options)
    if not np.isfinite(run.pixels).all():
        raise FoundError("pixels that are not finite")
    read_views([path, path], options)
    return "read"
