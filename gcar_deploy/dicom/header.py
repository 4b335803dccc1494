"""Open a DICOM XA file: bounded before anything is decoded, attributes found wherever they are.

Classic XA (1.2.840.10008.5.1.4.1.1.12.1) keeps attributes at the top of the data set; Enhanced XA
(...12.1.1) keeps them in functional groups, per frame or shared by all (PS3.3 C.7.6.16).
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import math
import warnings
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

from gcar_deploy.config import DicomLimits
from gcar_deploy.errors import GeometryError, ImageError, UsageError
from gcar_deploy.files import is_file, read_bounded

CLASSIC = "1.2.840.10008.5.1.4.1.1.12.1"
ENHANCED = "1.2.840.10008.5.1.4.1.1.12.1.1"
#: transfer syntax -> whether it may have lost something (PS3.5 chapter 8)
SYNTAXES = {
    "1.2.840.10008.1.2": False,  # implicit little endian
    "1.2.840.10008.1.2.1": False,  # explicit little endian
    "1.2.840.10008.1.2.5": False,  # run length
    "1.2.840.10008.1.2.4.50": True,  # JPEG baseline
    "1.2.840.10008.1.2.4.51": True,  # JPEG extended
    "1.2.840.10008.1.2.4.57": False,  # JPEG lossless
    "1.2.840.10008.1.2.4.70": False,  # JPEG lossless, first-order prediction
    "1.2.840.10008.1.2.4.80": False,  # JPEG-LS
    "1.2.840.10008.1.2.4.81": True,
    "1.2.840.10008.1.2.4.90": False,  # JPEG 2000
    "1.2.840.10008.1.2.4.91": True,
}
#: how every kind of JPEG begins
JPEG = "1.2.840.10008.1.2.4."
#: what a decoder must be told of the pixels
_COUNTS = (
    "Rows", "Columns", "BitsAllocated", "BitsStored", "SamplesPerPixel", "PixelRepresentation",
)  # fmt: skip
_NEEDED = (*_COUNTS, "PhotometricInterpretation")
_GREY = ("MONOCHROME1", "MONOCHROME2")
#: who the patient is; names are spelt in too many ways
PATIENT = ("PatientID", "PatientBirthDate", "PatientSex")
_DEFLATED = b"1.2.840.10008.1.2.1.99"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Header:
    """A run whose header was read and found within bounds; no pixel has been touched.

    Attributes
    ----------
    name : str, of the file
    data : bytes of the file
    dataset : pydicom.Dataset without pixels
    enhanced : bool, Enhanced XA
    rows, columns, frames : int
    bits : int, bits allocated per pixel
    syntax : str, transfer syntax UID
    sha256 : str, of the file's bytes
    """

    name: str
    data: bytes
    dataset: Any
    enhanced: bool
    rows: int
    columns: int
    frames: int
    bits: int
    syntax: str
    sha256: str

    def find(self, keyword: str, frame: int = 0) -> Any:
        """Value of an attribute for one frame (from 0); None where it is absent or empty."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # values are checked where they are used
                for group in self._groups(frame):
                    for element in group:
                        if element.VR == "SQ" and element.value and keyword in element.value[0]:
                            return _filled(element.value[0][keyword].value)
                return _filled(self.dataset.get(keyword))
        except MemoryError:
            raise
        except Exception:  # noqa: BLE001 - pydicom's errors share no base class
            raise GeometryError(f"{self.name}: {tag(keyword)} cannot be read") from None

    def number(self, keyword: str, frame: int = 0) -> float | None:
        """Return a finite number; None where the attribute is absent or empty.

        Raises
        ------
        GeometryError
            The value is no number.
        """
        value = self.find(keyword, frame)
        return None if value is None else self._float(keyword, value)

    def numbers(self, keyword: str, frame: int = 0) -> tuple[float, ...] | None:
        """Return all values of an attribute as finite numbers; None where it is absent."""
        value = self.find(keyword, frame)
        if value is None:
            return None
        many = [value] if isinstance(value, (str, int, float)) else value
        return tuple(self._float(keyword, x) for x in many)

    def pair(self, keyword: str, frame: int = 0) -> tuple[float, float] | None:
        """Return two numbers, (row, column) in DICOM's usual order; None where absent."""
        found = self.numbers(keyword, frame)
        if found is None:
            return None
        if len(found) != 2:
            raise GeometryError(f"{self.name}: {tag(keyword)} holds {len(found)} values, not 2")
        return found[0], found[1]

    def text(self, keyword: str, frame: int = 0) -> str:
        """Return a coded value in capitals; empty where absent."""
        value = self.find(keyword, frame)
        return "" if value is None else str(value).strip().upper()

    def _float(self, keyword: str, value: Any) -> float:
        try:
            out = float(value)
        except (TypeError, ValueError):
            out = math.nan
        if not math.isfinite(out):
            raise GeometryError(f"{self.name}: {tag(keyword)} = {str(value)[:40]!r} is no number")
        return out

    def _groups(self, frame: int) -> list[Any]:
        if not self.enhanced:
            return []
        own = self.dataset.get("PerFrameFunctionalGroupsSequence") or []
        shared = self.dataset.get("SharedFunctionalGroupsSequence") or []
        return [*([own[frame]] if frame < len(own) else []), *shared[:1]]


def told_apart(one: Mapping[str, str], other: Mapping[str, str]) -> list[str]:
    """Keywords of which both tell, and tell otherwise."""
    return [key for key in one if one[key] and other[key] and one[key] != other[key]]


def tag(keyword: str) -> str:
    """Name an attribute for people: keyword and number."""
    from pydicom.datadict import tag_for_keyword

    number = tag_for_keyword(keyword)
    return keyword if number is None else f"{keyword} ({number >> 16:04X},{number & 0xFFFF:04X})"


def is_dicom(path: str | Path) -> bool:
    """Tell by name or by the mark at byte 128; False for what cannot be opened."""
    path = Path(path)
    if path.suffix.lower() in (".dcm", ".dicom", ".ima"):
        return True
    if path.suffix.lower() in (".png", ".tif", ".tiff", ".npy") or not is_file(path):
        return False
    try:
        with path.open("rb") as stream:
            return stream.read(132)[128:] == b"DICM"
    except OSError:
        return False


def read_header(path: str | Path, limits: DicomLimits | None = None) -> Header:
    """Read a run's header and hold it against the limits.

    Raises
    ------
    ImageError
        Missing, not DICOM, not XA, damaged, or larger than the limits allow.
    UsageError
        The extra ``dicom`` is not installed.
    """
    limits = limits or DicomLimits()
    path = Path(path)
    _need_pydicom()
    try:
        data = read_bounded(path, limits.max_bytes)
        return _header(path.name, data, limits)
    except ValueError as error:
        raise ImageError(f"{path.name}: {error}") from None


def _need_pydicom() -> None:
    try:
        import pydicom  # noqa: F401
    except ImportError:
        raise UsageError("DICOM files need the extra 'dicom': pip install 'gcar[dicom]'") from None
    # Its complaints about single values would reach stderr; what matters is checked here.
    logging.getLogger("pydicom").addHandler(logging.NullHandler())


def _header(name: str, data: bytes, limits: DicomLimits) -> Header:
    import pydicom

    if data[128:132] != b"DICM":
        raise ValueError("is not a DICOM file (no mark at byte 128); export it again")
    if _DEFLATED in data[:2048]:
        raise ValueError("is deflated as a whole, which is not supported; export it without")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # values are checked where they are used
            stream = BytesIO(data)
            dataset = pydicom.dcmread(stream, stop_before_pixels=True)
            syntax = str(dataset.file_meta.TransferSyntaxUID)
            kind = str(dataset.get("SOPClassUID", "")) or "nothing"
            missing = [k for k in _NEEDED if dataset.get(k) in (None, "")]
            frames = int(dataset.get("NumberOfFrames") or 1)
            counts = (int(dataset.get(k) or 0) for k in _COUNTS)
            rows, columns, bits, stored, samples, signed = counts
            high = dataset.get("HighBit")
            high = stored - 1 if high is None else int(high)
            grey = str(dataset.get("PhotometricInterpretation")).strip().upper()
    except MemoryError:
        raise
    except Exception:  # noqa: BLE001 - pydicom's errors share no base class
        raise ValueError("has a damaged header; export it again") from None
    if stream.tell() >= len(data) and (kind == "nothing" or ENHANCED.startswith(kind)):
        raise ValueError("ends before its pixels (truncated); copy or export it again")
    if kind not in (CLASSIC, ENHANCED):
        raise ValueError(f"holds {_kind_name(kind)}; X-ray angiography (XA) is needed")
    if syntax not in SYNTAXES:
        raise ValueError(f"is encoded as {_kind_name(syntax)}, which is not supported")
    if missing:
        raise ValueError(f"has no {tag(missing[0])}; export it again")
    _check_size(rows, columns, frames, bits, limits)
    if samples != 1 or signed or not 1 <= stored <= bits or grey not in _GREY:
        raise ValueError("holds colour or signed pixels; XA is unsigned grey")
    # Compressed streams hold whole cells of their own depth: where the bits lie is not for sure.
    if not stored <= high + 1 <= (stored if syntax.startswith(JPEG) else bits):
        raise ValueError(
            f"has {tag('HighBit')} = {high}; for {stored} bits stored it must be {stored - 1}"
        )
    return Header(
        name=name, data=data, dataset=dataset, enhanced=kind == ENHANCED, rows=rows,
        columns=columns, frames=frames, bits=bits, syntax=syntax,
        sha256=hashlib.sha256(data).hexdigest(),
    )  # fmt: skip


def _kind_name(uid: str) -> str:
    """Name a UID for people, short and printable whatever the file holds."""
    from pydicom.uid import UID_dictionary

    if uid in UID_dictionary:
        return str(UID_dictionary[uid][0])
    return "".join(c for c in uid if c.isprintable())[:64]


def _check_size(rows: int, columns: int, frames: int, bits: int, limits: DicomLimits) -> None:
    if not limits.min_side <= min(rows, columns) <= max(rows, columns) <= limits.max_side:
        raise ValueError(
            f"is {columns} x {rows} pixels (columns x rows); each side must be "
            f"{limits.min_side} .. {limits.max_side}"
        )
    if not 1 <= frames <= limits.max_frames:
        raise ValueError(f"has {frames} frames; 1 .. {limits.max_frames} are read")
    if rows * columns * frames > limits.max_pixels:
        raise ValueError(
            f"has {rows * columns * frames / 1e6:.0f} million pixels in all frames; at most "
            f"{limits.max_pixels / 1e6:.0f} million are read"
        )
    if bits not in (8, 16):
        raise ValueError(f"has {bits} bits per pixel; 8 or 16 are needed")


def _filled(value: Any) -> Any:
    """None for what DICOM writes as an empty value."""
    if value is None or (hasattr(value, "__len__") and len(value) == 0):
        return None
    return value
