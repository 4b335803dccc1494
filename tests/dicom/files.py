"""Small XA files, written attribute by attribute; no patient, no vendor."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.sequence import Sequence
from pydicom.uid import JPEGLosslessSV1, generate_uid

from gcar_deploy.dicom.header import CLASSIC, ENHANCED

EXPLICIT = "1.2.840.10008.1.2.1"
SIDE = 64
#: what a complete classic run says of its geometry
GEOMETRY = {
    "PositionerPrimaryAngle": "30",
    "PositionerSecondaryAngle": "-20",
    "DistanceSourceToDetector": "1100",
    "DistanceSourceToPatient": "765",
    "ImagerPixelSpacing": ["1.6", "1.6"],
}


def vessel_frames(count: int = 1, filled: int | None = None) -> np.ndarray:
    """(count, SIDE, SIDE) uint8: a dark line on grey, strongest in frame ``filled``."""
    row, column = np.indices((SIDE, SIDE))
    line = np.exp(-0.5 * ((row - 32 - 8 * np.sin(column / 9.0)) / 1.5) ** 2)
    out = []
    for k in range(count):
        gain = 90.0 if filled is None else 90.0 * np.exp(-0.5 * ((k - filled) / 1.5) ** 2)
        out.append(200.0 - gain * line)
    return np.rint(out).astype(np.uint8)


def basic(pixels: np.ndarray, kind: str) -> FileDataset:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = kind
    meta.MediaStorageSOPInstanceUID = generate_uid()
    meta.TransferSyntaxUID = EXPLICIT
    ds = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
    ds.SOPClassUID, ds.SOPInstanceUID = kind, meta.MediaStorageSOPInstanceUID
    ds.Modality = "XA"
    frames, ds.Rows, ds.Columns = pixels.shape
    ds.NumberOfFrames = frames
    ds.SamplesPerPixel, ds.PixelRepresentation = 1, 0
    ds.PhotometricInterpretation = "MONOCHROME2"
    ds.BitsAllocated = ds.BitsStored = 8 * pixels.dtype.itemsize
    ds.HighBit = ds.BitsStored - 1
    ds.PixelData = pixels.tobytes()
    return ds


def classic(pixels: np.ndarray | None = None, **changes: object) -> FileDataset:
    """A classic run; ``changes`` set attributes, None leaves one out."""
    ds = basic(vessel_frames() if pixels is None else pixels, CLASSIC)
    for key, value in {**GEOMETRY, "PixelIntensityRelationship": "LIN", **changes}.items():
        if value is not None:
            setattr(ds, key, value)
    return ds


def enhanced(pixels: np.ndarray, per_frame: list[dict], shared: dict) -> FileDataset:
    """An Enhanced run; dicts: functional group keyword -> {attribute: value}."""
    ds = basic(pixels, ENHANCED)
    ds.SharedFunctionalGroupsSequence = Sequence([group(shared)])
    ds.PerFrameFunctionalGroupsSequence = Sequence([group(one) for one in per_frame])
    return ds


def group(content: dict) -> Dataset:
    item = Dataset()
    for keyword, attributes in content.items():
        inner = Dataset()
        for key, value in attributes.items():
            setattr(inner, key, value)
        setattr(item, keyword, Sequence([inner]))
    return item


def tiny_runs(folder: Path, **changes: object) -> list[Path]:
    """Two files of the small generated tree: attenuation, vessels bright."""
    from gcar_deploy.selftest import tiny_case

    files = []
    for number, angiogram in enumerate(tiny_case()[0], start=1):
        told = {
            "PositionerPrimaryAngle": str(angiogram.carm.primary_angle_deg),
            "PositionerSecondaryAngle": str(angiogram.carm.secondary_angle_deg),
            "PixelIntensityRelationship": "LOG",
            "PixelIntensityRelationshipSign": -1,
        }
        run = classic(angiogram.pixels.astype(np.uint16)[None], **{**told, **changes})
        files.append(save(run, folder / f"run{number}.dcm"))
    return files


def save(ds: FileDataset, path: Path) -> Path:
    ds.save_as(path, enforce_file_format=True)
    return path


def as_bytes(ds: FileDataset) -> bytes:
    stream = BytesIO()
    ds.save_as(stream, enforce_file_format=True)
    return stream.getvalue()


def jpeg_lossless(source: Path, target: Path) -> Path:
    """Re-encode a file as JPEG lossless, first-order prediction."""
    import gdcm

    reader = gdcm.ImageReader()
    reader.SetFileName(str(source))
    assert reader.Read()
    change = gdcm.ImageChangeTransferSyntax()
    change.SetTransferSyntax(gdcm.TransferSyntax(gdcm.TransferSyntax.JPEGLosslessProcess14_1))
    change.SetInput(reader.GetImage())
    assert change.Change()
    writer = gdcm.ImageWriter()
    writer.SetFileName(str(target))
    writer.SetFile(reader.GetFile())
    writer.SetImage(change.GetOutput())
    assert writer.Write()
    assert JPEGLosslessSV1.encode() in target.read_bytes()[:1024]
    return target
