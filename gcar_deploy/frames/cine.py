"""Runs of several frames: DICOM, a folder of pictures, or a TIFF of several pages."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gcar_deploy.config import RunOptions
from gcar_deploy.dicom.carm import is_flipped
from gcar_deploy.dicom.choose import r_wave_frames
from gcar_deploy.dicom.frames import Frames
from gcar_deploy.dicom.header import Header, is_dicom, read_header
from gcar_deploy.dicom.shutter import open_field
from gcar_deploy.errors import ImageError
from gcar_deploy.files import frames_in, is_folder
from gcar_deploy.imaging.read import is_stack, read_picture, read_stack
from gcar_deploy.types import Image, Mask


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Cine:
    """A run whose frames are read one at a time.

    Attributes
    ----------
    name : of its file or folder, for messages
    count : of frames
    read : frame (from 0) -> (rows, cols) float32 counts, bit depth, SHA-256 of its file
    valid : (rows, cols) bool, where the file says that there is a picture; None for everywhere
    header : of a DICOM run, else None
    """

    name: str
    count: int
    read: Callable[[int], tuple[Image, int, str]]
    valid: Mask | None = None
    header: Header | None = None

    def __len__(self) -> int:
        return self.count

    def decode(self, index: int) -> Image:
        """(rows, cols) float32 counts of a frame, from 0; a stored mirror image is turned back."""
        return self.read(index)[0]

    @property
    def r_waves(self) -> list[int]:
        """Frames (from 0) at an R wave, where the file says so."""
        return [] if self.header is None else r_wave_frames(self.header)

    @property
    def frame_ms(self) -> float | None:
        """Time from frame to frame, where the file says so."""
        if self.header is None:
            return None
        steps = self.header.numbers("FrameTimeVector")
        if steps is not None and len(steps) == self.count and self.count > 1:
            return float(np.mean(steps[1:])) or None
        step = self.header.number("FrameTime")
        return float(step) if step else None


def is_cine(path: str | Path) -> bool:
    """Whether a path is a folder or a TIFF of several pages: a run that is no DICOM file."""
    return is_folder(path) or is_stack(path)


def open_cine(
    path: str | Path,
    options: RunOptions,
    *,
    subtracted: bool = False,
    check: Callable[[], None] | None = None,
) -> Cine | None:
    """Open a run; None for a single picture.

    Parameters
    ----------
    path : of a file or a folder of pictures
    subtracted : as ``imaging.read.read_picture``
    check : called before each frame is read; what it raises ends the reading

    Raises
    ------
    ImageError, UsageError
    """
    path = Path(path)
    if is_folder(path):
        cine: Cine | None = _of_folder(path, options, subtracted)
    elif is_dicom(path):
        cine = _of_dicom(path, options)
    else:
        cine = _of_stack(path, options, subtracted) if is_stack(path) else None
    if cine is None or check is None:
        return cine
    own = cine.read

    def read(index: int) -> tuple[Image, int, str]:
        check()
        return own(index)

    return dataclasses.replace(cine, read=read)


def _of_dicom(path: Path, options: RunOptions) -> Cine | None:
    header = read_header(path, options.dicom.limits)
    if header.frames < 2:
        return None
    frames = Frames(header)

    def turned(picture: Image, index: int) -> Image:
        return np.ascontiguousarray(picture[:, ::-1]) if is_flipped(header, index) else picture

    def read(index: int) -> tuple[Image, int, str]:
        return turned(frames.decode(index), index), header.bits, header.sha256

    valid = open_field(header, 0)
    if valid is not None and is_flipped(header, 0):
        valid = np.ascontiguousarray(valid[:, ::-1])
    return Cine(name=path.name, count=header.frames, read=read, valid=valid, header=header)


def _of_folder(path: Path, options: RunOptions, subtracted: bool) -> Cine:
    """Open the pictures of a folder in the order of the numbers in their names."""
    try:
        pictures = frames_in(path)
    except ValueError as error:
        raise ImageError(f"{path.name}: {error}") from None
    limits = options.dicom.limits
    if not pictures and any(map(is_dicom, path.iterdir())):
        raise ImageError(f"{path.name}: the folder holds DICOM files; name the run's file itself")
    if not pictures:
        raise ImageError(f"{path.name}: the folder holds no picture (.png, .tif, .npy)")
    if len(pictures) > limits.max_frames:
        raise ImageError(
            f"{path.name}: the folder holds {len(pictures)} pictures; at most "
            f"{limits.max_frames} frames are read"
        )
    take = functools.partial(read_picture, limits=options.imaging.limits, subtracted=subtracted)
    first, depth, _ = take(pictures[0])

    @functools.lru_cache(maxsize=2)
    def read(index: int) -> tuple[Image, int, str]:
        picture, own, sha256 = take(pictures[index])
        if picture.shape != first.shape or own != depth:
            raise ImageError(
                f"{path.name}: {pictures[index].name} has {picture.shape} (rows, columns) of "
                f"{own} bit, {pictures[0].name} has {first.shape} of {depth} bit; a folder holds "
                "the frames of one run"
            )
        return picture, own, sha256

    return Cine(name=path.name, count=len(pictures), read=read)


def _of_stack(path: Path, options: RunOptions, subtracted: bool) -> Cine:
    pages, depth, sha256 = read_stack(path, options.dicom.limits, subtracted=subtracted)
    return Cine(name=path.name, count=len(pages), read=lambda k: (pages[k], depth, sha256))
