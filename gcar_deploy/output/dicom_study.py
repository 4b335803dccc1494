"""A result as DICOM objects of the study that its pictures came from, by pydicom.

The surface becomes an Encapsulated STL (PS3.3 A.85), each overlay a Secondary Capture (A.8), the
measurements a structured report (``dicom_sr``), a printed page an Encapsulated PDF (A.45). Who the
patient is and which study it was are copied from the first run, as UTF-8; nothing else is. What
pydicom and highdicom say of a value quotes it, so it stays in here.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import warnings
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pydicom
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.uid import (
    UID,
    EncapsulatedPDFStorage,
    ExplicitVRLittleEndian,
    SecondaryCaptureImageStorage,
    generate_uid,
)
from pydicom.valuerep import DA, TM, PersonName

from gcar_deploy.dicom.header import PATIENT, told_apart
from gcar_deploy.errors import GcarError, ImageError, UsageError
from gcar_deploy.output.dicom_sr import measurement_report
from gcar_deploy.output.dicom_stl import dicom_stl, equipment
from gcar_deploy.output.stored import read_folder, read_listed

#: which study and which picture it is
_UIDS = ("StudyInstanceUID", "SeriesInstanceUID", "SOPClassUID", "SOPInstanceUID")
#: of the Patient and General Study modules (PS3.3 C.7.1.1, C.7.2.1) what must stand in every
#: object, empty where nobody knows (type 2)
_EMPTY = (
    "PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyDate", "StudyTime",
    "ReferringPhysicianName", "StudyID", "AccessionNumber",
)  # fmt: skip
_OVERLAY_FILES = "overlay_view*.png"
_OVERLAYS = "Coronary tree over the X-ray pictures, research use only"
_PAGE = "Coronary report, research use only"


def study_objects(folder: Path, runs: Sequence[Path], pdf: Path | None = None) -> dict[str, Any]:
    """Make the objects of a result folder.

    Parameters
    ----------
    folder : result folder
    runs : DICOM files of its pictures
    pdf : a page printed from the report, or None

    Returns
    -------
    name of a file -> data set with file meta information: the surface, the overlays as one series,
    the measurements, the page

    Raises
    ------
    GcarError
        A file cannot be read or is not as it was written, the result was not made from these
        runs, they are of several studies, highdicom is missing, or it takes a value amiss.
    """
    try:
        with warnings.catch_warnings(action="ignore"):
            return _objects(folder, runs, pdf)
    except (GcarError, MemoryError):
        raise
    except Exception as error:  # noqa: BLE001 - the libraries' errors share no base class
        raise GcarError(
            f"a value in the header of {runs[0].name} cannot be written ({type(error).__name__})"
        ) from None


def _objects(folder: Path, runs: Sequence[Path], pdf: Path | None) -> dict[str, Any]:
    stored = read_folder(folder)
    headers = [_header(run, stored.summary) for run in runs]
    if len(headers) != len(stored.summary["views"]):
        raise UsageError(f"{len(headers)} runs: the result has {len(stored.summary['views'])}")
    whose = [{key: str(one[key].value).strip().upper() for key in PATIENT} for one in headers]
    for one, other in itertools.combinations(whose, 2):
        for keyword in told_apart(one, other):
            raise UsageError(
                f"the runs tell of different patients ({keyword}): the result belongs to neither"
            )
    study = headers[0]
    mesh = read_listed(folder, "surface.stl", stored.summary)
    surface = dicom_stl(mesh, [str(study.StudyInstanceUID)])
    # Those that result.json lists: what else lies in the folder may be of another patient.
    overlays = sorted(n for n in stored.summary["files"] if fnmatchcase(n, _OVERLAY_FILES))
    series = generate_uid()
    made = {"surface.dcm": surface}
    for k, name in enumerate(overlays, start=1):
        picture = read_listed(folder, name, stored.summary)
        made[f"{Path(name).stem}.dcm"] = _capture(name, picture, k, series)
    if pdf is not None:
        made["page.dcm"] = _page(pdf)
    for data in made.values():
        for keyword in ("SpecificCharacterSet", "StudyInstanceUID", "StudyDescription", *_EMPTY):
            if keyword in study:
                setattr(data, keyword, study[keyword].value)
    made["measurements.dcm"] = measurement_report(
        stored, headers, str(surface.FrameOfReferenceUID), (generate_uid(), 3)
    )
    return {name: _as_stored(data) for name, data in made.items()}


def _header(run: Path, told: Mapping[str, Any]) -> Any:
    """Who and what a run is of that the result was made from: nobody else's study gets it."""
    try:
        data = run.read_bytes()
        found = pydicom.dcmread(io.BytesIO(data), stop_before_pixels=True)
    except (OSError, pydicom.errors.InvalidDicomError):
        raise ImageError(f"{run.name} cannot be read as DICOM") from None
    own = hashlib.sha256(data).hexdigest()
    if own not in {view["picture"]["sha256"] for view in told["views"]}:
        raise UsageError(f"{run.name} is none of the files that the result was made from")
    missing = [k for k in _UIDS if not found.get(k)]
    if missing:
        raise ImageError(f"{run.name} has no {missing[0]}: no object can be filed beside it")
    out = Dataset()
    # Not the file's own: what it holds may be no name of the standard, or have an empty first part.
    out.SpecificCharacterSet = "ISO_IR 192"
    for keyword in _UIDS:
        setattr(out, keyword, str(found[keyword].value))
    for keyword in _EMPTY:
        setattr(out, keyword, _allowed(keyword, _text(found, keyword)))
    if "StudyDescription" in found:
        out.StudyDescription = _text(found, "StudyDescription")
    return out


def _text(data: Any, keyword: str) -> str:
    value = data.get(keyword)
    parts = [value] if value is None or isinstance(value, (str, PersonName)) else list(value)
    return "\\".join("" if part is None else str(part) for part in parts)


def _allowed(keyword: str, text: str) -> str:
    """Return a value as the standard writes it (PS3.5 6.2), empty where it has no such."""
    try:
        if keyword.endswith("Date"):
            return str(DA(text.replace(".", "")) or "")
        if keyword.endswith("Time"):
            return str(TM(text.replace(":", "")) or "")
    except ValueError:
        return ""
    return text if keyword != "PatientSex" or text in ("M", "F", "O") else ""


def file_bytes(data: Any) -> bytes:
    """Return a data set as the content of a DICOM file."""
    stream = io.BytesIO()
    with warnings.catch_warnings(action="ignore"):
        data.save_as(stream, enforce_file_format=True)
    return stream.getvalue()


def _as_stored(data: Any) -> Any:
    """Write and read once, so that every element has the encoding the meta information tells."""
    return pydicom.dcmread(io.BytesIO(file_bytes(data)))


def _new(kind: UID, modality: str, series: str, number: int) -> Any:
    """Return a data set with the modules that all share, empty where the run fills them in."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = kind
    meta.MediaStorageSOPInstanceUID = generate_uid()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
    data.SOPClassUID, data.SOPInstanceUID = kind, meta.MediaStorageSOPInstanceUID
    data.StudyInstanceUID, data.SeriesInstanceUID = generate_uid(), series
    for keyword in _EMPTY:
        setattr(data, keyword, "")
    data.Modality, data.ConversionType = modality, "WSD"
    data.SeriesNumber, data.InstanceNumber = number, 1
    data.BurnedInAnnotation = "NO"
    equipment(data)
    return data


def _capture(name: str, png: bytes, number: int, series: str) -> Any:
    """Secondary Capture of one PNG, red green blue."""
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise GcarError(f"{name} cannot be read back")
    data = _new(SecondaryCaptureImageStorage, "OT", series, 2)
    # An unpaired body part has no laterality, what a screen shows no orientation.
    data.BodyPartExamined, data.PatientOrientation = "HEART", ""
    data.InstanceNumber, data.SeriesDescription = number, _OVERLAYS
    data.Rows, data.Columns = picture.shape[:2]
    data.SamplesPerPixel, data.PhotometricInterpretation, data.PlanarConfiguration = 3, "RGB", 0
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 8, 8, 7, 0
    pixels = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB).tobytes()
    data.PixelData = pixels + b"\0" * (len(pixels) % 2)
    return data


def _page(path: Path) -> Any:
    """Wrap a printed page as Encapsulated PDF."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UsageError(f"{path.name} cannot be read ({error.strerror})") from None
    if not content.startswith(b"%PDF-"):
        raise UsageError(f"{path.name} is no PDF")
    data = _new(EncapsulatedPDFStorage, "DOC", generate_uid(), 4)
    data.SeriesDescription = data.DocumentTitle = _PAGE
    # The page bears the name of its case, which may be a person's.
    data.BurnedInAnnotation = "YES"
    data.ContentDate = data.ContentTime = data.AcquisitionDateTime = ""
    data.ConceptNameCodeSequence = []
    data.MIMETypeOfEncapsulatedDocument = "application/pdf"
    data.EncapsulatedDocumentLength = len(content)
    data.EncapsulatedDocument = content + b"\0" * (len(content) % 2)
    return data
