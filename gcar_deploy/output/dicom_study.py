"""A result as DICOM objects of the study that its pictures came from, by pydicom.

The surface becomes an Encapsulated STL (PS3.3 A.85), each overlay a Secondary Capture (A.8). Who
the patient is and which study it was are copied from the first run; nothing else is.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import cv2
import pydicom
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, SecondaryCaptureImageStorage, generate_uid

from gcar_deploy.errors import GcarError
from gcar_deploy.output.dicom_stl import dicom_stl, equipment

#: Patient and General Study modules (PS3.3 C.7.1.1, C.7.2.1), as far as they are told
_COPIED = (
    "SpecificCharacterSet", "PatientName", "PatientID", "PatientBirthDate", "PatientSex",
    "StudyInstanceUID", "StudyDate", "StudyTime", "ReferringPhysicianName", "StudyID",
    "AccessionNumber", "StudyDescription",
)  # fmt: skip
_OVERLAYS = "Coronary tree over the X-ray pictures, research use only"


def study_objects(folder: Path, run: Path) -> list[Any]:
    """Make the objects of a result folder.

    Parameters
    ----------
    folder : with ``surface.stl`` and ``overlay_view1.png`` ...
    run : DICOM file of one of the pictures

    Returns
    -------
    data sets with file meta information: the surface, then the overlays as one series

    Raises
    ------
    GcarError
        A file of the folder cannot be read.
    """
    study = pydicom.dcmread(run, stop_before_pixels=True)
    try:
        surface = dicom_stl((folder / "surface.stl").read_bytes(), [str(study.StudyInstanceUID)])
        overlays = sorted(folder.glob("overlay_view*.png"))
        series = generate_uid()
        made = [surface]
        made += [_capture(path, k, series) for k, path in enumerate(overlays, start=1)]
    except OSError as error:
        raise GcarError(f"{folder} cannot be read back ({error.strerror})") from None
    for data in made:
        for keyword in _COPIED:
            if keyword in study:
                setattr(data, keyword, study[keyword].value)
    return [_as_stored(data) for data in made]


def _as_stored(data: Any) -> Any:
    """Write and read once, so that every element has the encoding the meta information tells."""
    stream = io.BytesIO()
    data.save_as(stream, enforce_file_format=True)
    stream.seek(0)
    return pydicom.dcmread(stream)


def _capture(path: Path, number: int, series: str) -> Any:
    """Secondary Capture of one PNG, red green blue."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise GcarError(f"{path.name} cannot be read back")
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = SecondaryCaptureImageStorage
    meta.MediaStorageSOPInstanceUID = generate_uid()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
    data.SOPClassUID = SecondaryCaptureImageStorage
    data.SOPInstanceUID = meta.MediaStorageSOPInstanceUID
    data.StudyInstanceUID, data.SeriesInstanceUID = generate_uid(), series
    for keyword in (
        "PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyDate", "StudyTime",
        "ReferringPhysicianName", "StudyID", "AccessionNumber", "PatientOrientation",
    ):  # fmt: skip
        setattr(data, keyword, "")
    data.Modality, data.ConversionType, data.SeriesNumber = "OT", "WSD", 2
    data.InstanceNumber, data.SeriesDescription = number, _OVERLAYS
    data.BurnedInAnnotation = "NO"
    equipment(data)
    data.Rows, data.Columns = picture.shape[:2]
    data.SamplesPerPixel, data.PhotometricInterpretation, data.PlanarConfiguration = 3, "RGB", 0
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 8, 8, 7, 0
    pixels = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB).tobytes()
    data.PixelData = pixels + b"\0" * (len(pixels) % 2)
    return data
