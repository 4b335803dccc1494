"""surface.dcm: the lumen surface as DICOM Encapsulated STL (PS3.3 A.85), by pydicom.

The pictures may come without a patient, so patient and study are empty here; whoever files it
fills them in. Nothing depends on the clock: equal results give equal bytes.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

from gcar_deploy.errors import UsageError

_TITLE = "Coronary lumen, research use only"


def dicom_stl_bytes(stl: bytes, sources: Sequence[str] = ()) -> bytes:
    """Wrap a binary STL (mm, patient LPS) as a DICOM file.

    Parameters
    ----------
    stl : binary STL
    sources : SHA-256 of each picture; equal ones give the same study and frame of reference

    Raises
    ------
    UsageError
        pydicom is not installed.
    """
    stream = io.BytesIO()
    dicom_stl(stl, sources).save_as(stream, enforce_file_format=True)
    return stream.getvalue()


def dicom_stl(stl: bytes, sources: Sequence[str] = ()) -> Any:
    """Return the data set of ``dicom_stl_bytes``."""
    try:
        from pydicom.dataset import FileDataset, FileMetaDataset
        from pydicom.uid import EncapsulatedSTLStorage, ExplicitVRLittleEndian, generate_uid
    except ModuleNotFoundError:
        raise UsageError("pydicom is not installed: pip install 'gcar[dicom]'") from None
    origin = ["gcar", *sources]
    instance = generate_uid(entropy_srcs=[*origin, "instance", stl.hex()])
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = EncapsulatedSTLStorage
    meta.MediaStorageSOPInstanceUID = instance
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
    data.SOPClassUID, data.SOPInstanceUID = EncapsulatedSTLStorage, instance
    data.StudyInstanceUID = generate_uid(entropy_srcs=[*origin, "study"])
    data.SeriesInstanceUID = generate_uid(entropy_srcs=[*origin, "series", stl.hex()])
    data.FrameOfReferenceUID = generate_uid(entropy_srcs=[*origin, "frame"])
    for keyword in (
        "PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyDate", "StudyTime",
        "ReferringPhysicianName", "StudyID", "AccessionNumber", "PositionReferenceIndicator",
        "ContentDate", "ContentTime", "AcquisitionDateTime",
    ):  # fmt: skip
        setattr(data, keyword, "")
    data.Modality, data.SeriesNumber, data.InstanceNumber = "M3D", 1, 1
    equipment(data)
    _model(data)
    data.BurnedInAnnotation = "NO"
    data.MIMETypeOfEncapsulatedDocument = "model/stl"
    data.EncapsulatedDocumentLength = len(stl)
    # Values have an even length in DICOM; the true one stands above.
    data.EncapsulatedDocument = stl + b"\0" * (len(stl) % 2)
    return data


def equipment(data: Any) -> None:
    """Enhanced General Equipment module."""
    from importlib.metadata import version

    data.Manufacturer, data.ManufacturerModelName = "gcar", "gcar"
    data.DeviceSerialNumber, data.SoftwareVersions = "none", version("gcar")


def _model(data: Any) -> None:
    """Manufacturing 3D Model module: millimetres, neither changed nor mirrored."""
    data.DocumentTitle = data.SeriesDescription = _TITLE
    data.ConceptNameCodeSequence = []
    data.MeasurementUnitsCodeSequence = [_code("mm", "UCUM", "mm")]
    data.ModelModification, data.ModelMirroring = "NO", "NO"
    data.ModelUsageCodeSequence = [_code("129017", "DCM", "Simulation Intent")]
    data.ContentDescription = "Closed lumen surface, mm, patient LPS"


def _code(value: str, scheme: str, meaning: str) -> Any:
    from pydicom.dataset import Dataset

    code = Dataset()
    code.CodeValue, code.CodingSchemeDesignator, code.CodeMeaning = value, scheme, meaning
    return code
