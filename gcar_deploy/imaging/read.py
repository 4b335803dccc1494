"""Read one picture from disk: PNG, TIFF or NPY, nothing lost, nothing turned, nothing run."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from gcar_deploy import files
from gcar_deploy.config import DicomLimits, PictureLimits
from gcar_deploy.errors import ImageError
from gcar_deploy.files import read_bounded
from gcar_deploy.imaging import npy_header, png_guard
from gcar_deploy.types import Array, Image

_log = logging.getLogger(__name__)
#: the level of OpenCV's messages is one for all threads
_ONE_DECODER = threading.Lock()
_JPEG_SIGNATURE = b"\xff\xd8\xff"
_BIG_TIFF = (b"II+\x00", b"MM\x00+")
_NPY_DEPTH = {"uint8": 8, "uint16": 16, "float32": 32, "float64": 64}
_TYPE_OF = {8: np.uint8, 16: np.uint16, 32: np.float32}
#: a multi-page file that is larger is no run
_MOST_STACK_BYTES = DicomLimits().max_bytes
#: of pictures, and what they hold
SUFFIXES = {".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF", ".npy": "NPY"}


def read_picture(
    path: str | Path,
    limits: PictureLimits | None = None,
    *,
    subtracted: bool = False,
    binary: bool = False,
) -> tuple[Image, int, str]:
    """Read a picture; the file is opened once, only for reading.

    Parameters
    ----------
    path : str or Path
        ``.png``, ``.tif``/``.tiff`` (8 or 16 bit grey, or colour with R = G = B and no
        transparency; TIFF also non-negative float32) or ``.npy`` (2-D uint8, uint16, or finite
        non-negative float32/64).
    limits : PictureLimits, optional
    subtracted : bool, another picture was, so that noise lies about 0; see ``from_zero``
    binary : bool, it is a mask: truth values (NPY) and grey of 1 bit (PNG, TIFF) are taken too

    Returns
    -------
    pixels : (rows, cols) float32, counts
    bit_depth : int, 8, 16, 32 or 64
    sha256 : str, of the file's bytes

    Raises
    ------
    ImageError
        One line: the file's name, what is wrong, what to do.
    """
    limits = limits or PictureLimits()
    path = Path(path)
    try:
        data = read_bounded(path, limits.max_bytes)
        array, depth = _decode(data, path.suffix.lower(), limits, binary)
        array = from_zero(array) if subtracted else array
        _check_counts(array)
    except ValueError as error:
        raise ImageError(f"{path.name}: {error}") from None
    pixels = np.ascontiguousarray(array, dtype=np.float32)
    sha256 = hashlib.sha256(data).hexdigest()
    _log.debug("read %d bytes, %s, %d bit, sha256 %s", len(data), pixels.shape, depth, sha256)
    return pixels, depth, sha256


def check_opens(path: str | Path) -> None:
    """Refuse what is no file, or cannot be opened, before more is said of what it is not.

    Raises
    ------
    ImageError
    """
    try:
        files.check_opens(path)
    except ValueError as error:
        raise ImageError(f"{Path(path).name}: {error}") from None


def is_stack(path: str | Path) -> bool:
    """Whether a file is a TIFF of several pages; False for what cannot be read."""
    path = Path(path)
    if path.suffix.lower() not in (".tif", ".tiff"):
        return False
    try:
        data = read_bounded(path, _MOST_STACK_BYTES)
    except ValueError:
        return False
    return _sniff(data) == "TIFF" and png_guard.has_pages(data)


def read_stack(
    path: str | Path, limits: DicomLimits, *, subtracted: bool = False
) -> tuple[list[Image], int, str]:
    """Read the pages of a TIFF, the frames of a run; see ``read_picture``.

    Parameters
    ----------
    limits : DicomLimits, what a run may be
    subtracted : as ``read_picture``

    Returns
    -------
    pages : (rows, cols) float32 each
    bit_depth, sha256

    Raises
    ------
    ImageError
    """
    path = Path(path)
    try:
        data = read_bounded(path, min(limits.max_bytes, _MOST_STACK_BYTES))
        depth, (rows, columns), count = png_guard.check_tiff_pages(
            data, limits.min_side, limits.max_side, limits.max_frames
        )
        if rows * columns * count > limits.max_pixels:
            raise ValueError(f"holds {count} pages of {columns} x {rows} pixels, which is too much")
        try:
            with quiet_decoder():
                done, pages = cv2.imdecodemulti(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            done, pages = False, ()
        if not done or len(pages) != count or any(p.dtype != _TYPE_OF[depth] for p in pages):
            raise ValueError("cannot be decoded (damaged or unusual); export its frames as PNG")
        grey = [_one_channel(page) for page in pages]
        grey = [from_zero(page) for page in grey] if subtracted else grey
        for page in grey:
            if page.shape != (rows, columns):
                raise ValueError("holds pages of several sizes")
            _check_counts(page)
    except ValueError as error:
        raise ImageError(f"{path.name}: {error}") from None
    return [page.astype(np.float32) for page in grey], depth, hashlib.sha256(data).hexdigest()


@contextlib.contextmanager
def quiet_decoder() -> Iterator[None]:
    """Keep OpenCV from writing to stderr what a damaged file is told of by an error."""
    with _ONE_DECODER:
        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            yield
        finally:
            cv2.utils.logging.setLogLevel(level)


def _decode(data: bytes, suffix: str, limits: PictureLimits, binary: bool) -> tuple[Array, int]:
    expected = SUFFIXES.get(suffix)
    if data.startswith(_JPEG_SIGNATURE):
        raise ValueError(
            "is a JPEG picture: its compression loses thin vessels; export PNG, TIFF, NPY or DICOM"
        )
    if expected is None:
        raise ValueError("has an unknown kind of name; use .png, .tif, .tiff, .npy or DICOM")
    if data.startswith(_BIG_TIFF):
        raise ValueError("is a BigTIFF file; export it as TIFF of up to 4 GB, or as PNG")
    found = _sniff(data)
    if found != expected:
        what = f"is a {found} file" if found else f"is not a {expected} file"
        raise ValueError(f"{what} though it is named {suffix}; export it as {expected}")
    if found == "NPY":
        return _decode_npy(data, limits, binary)
    check = png_guard.check_png if found == "PNG" else png_guard.check_tiff
    depth = check(data, limits.min_side, limits.max_side, binary=binary)
    try:
        # UNCHANGED: GRAYSCALE would make 8 bit of 16 and obey an EXIF rotation.
        with quiet_decoder():
            picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        picture = None
    if picture is None or picture.dtype != _TYPE_OF[depth]:
        raise ValueError("cannot be decoded (damaged or unusual); export it again as 8/16 bit grey")
    grey = _one_channel(picture)
    png_guard.check_sides(grey.shape[0], grey.shape[1], limits.min_side, limits.max_side)
    return grey, depth


def _sniff(data: bytes) -> str | None:
    if data.startswith(png_guard.PNG_SIGNATURE):
        return "PNG"
    if data[:4] in png_guard.TIFF_SIGNATURES:
        return "TIFF"
    return "NPY" if data.startswith(npy_header.SIGNATURE) else None


def _one_channel(picture: Array) -> Array:
    if picture.ndim == 2:
        return picture
    channels = picture.shape[2]
    if channels in (2, 4):
        if (picture[..., -1] != np.iinfo(picture.dtype).max).any():
            raise ValueError("has transparent pixels; export it without transparency")
        picture = picture[..., :-1]
    if (picture != picture[..., :1]).any():
        raise ValueError("is a colour picture; export it as grey (R = G = B)")
    return picture[..., 0]


def _decode_npy(data: bytes, limits: PictureLimits, binary: bool) -> tuple[Array, int]:
    try:
        dtype, fortran, shape, start = npy_header.read_header(data)
    except ValueError:
        raise ValueError("has a damaged NPY header; save it again with numpy.save") from None
    depths = {**_NPY_DEPTH, "bool": 8} if binary else _NPY_DEPTH
    if dtype is None or dtype.name not in depths:
        raise ValueError("holds other values than uint8, uint16, float32 or float64; convert it")
    if len(shape) != 2:
        raise ValueError(f"has {len(shape)} dimensions; save one grey picture (rows, columns)")
    png_guard.check_sides(*shape, limits.min_side, limits.max_side)
    if len(data) - start != shape[0] * shape[1] * dtype.itemsize:
        raise ValueError("is truncated or has bytes to spare; save it again with numpy.save")
    array = np.frombuffer(data, dtype, offset=start)
    return array.reshape(shape, order="F" if fortran else "C"), depths[dtype.name]


def from_zero(array: Array) -> Array:
    """Return a subtracted picture without what lies below 0, if that is but its noise.

    What is as far below 0 as anything above it is no noise, and left for others to refuse.
    """
    if array.dtype.kind != "f" or not np.isfinite(array).all() or -array.min() >= array.max():
        return array
    return np.maximum(array, 0)


def _check_counts(array: Array) -> None:
    """Refuse floating-point numbers that are no grey values."""
    if array.dtype.kind != "f":
        return
    if not (np.isfinite(array).all() and array.min() >= 0):
        raise ValueError("holds negative or non-finite values; grey values must be >= 0 and finite")
    if array.max() > np.finfo(np.float32).max:
        raise ValueError("holds values too large for single precision; rescale it")
