"""Which frame of a run to use: full contrast, end of diastole, little motion."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Protocol

import cv2
import numpy as np

from gcar_deploy.dicom.header import Header
from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import DEFAULT_FIELD_MM
from gcar_deploy.imaging.polarity import is_dark_run
from gcar_deploy.types import Array, Image, Scalars

#: frames filled to this share of the best are compared by their stillness
_FILLED_SHARE = 0.9
#: a frame named by the file but filled less than this share of the best is worth a word
_LEAST_FILLED_SHARE = 0.5
#: frames are compared at this size, pixels along the longer side
_SIDE = 192


@dataclasses.dataclass(frozen=True, kw_only=True)
class Choice:
    """A frame and why it was taken.

    Attributes
    ----------
    index : int, from 0
    reason : str, ends the sentence 'frame 7 of 14: ...'
    note : str or None, a doubt worth telling
    """

    index: int
    reason: str
    note: str | None = None


class FrameSource(Protocol):
    """A run whose frames can be read one at a time; a header where it is a DICOM run."""

    @property
    def header(self) -> Header | None:
        """Header of a DICOM run."""

    def __len__(self) -> int: ...

    def decode(self, index: int) -> Image:
        """(rows, columns) float32 counts of a frame, from 0."""


def choose_frame(
    frames: FrameSource, wanted: int | None, name: str = "", intensity: Intensity | None = None
) -> Choice:
    """Take the frame asked for, else one at an R wave, the file's own, or the best filled.

    Parameters
    ----------
    frames : Frames, or another run of several pictures
    wanted : int from 1, or None to choose
    name : of the run, for messages; the header's where it has one
    intensity : what a count means; None where nobody says it

    Raises
    ------
    UsageError
        ``wanted`` is not a frame of the run.
    ImageError
        A frame cannot be decoded.
    """
    header = frames.header
    if wanted is not None:
        if not 1 <= wanted <= len(frames):
            name = name if header is None else header.name
            raise UsageError(f"--frame {wanted} is outside 1 .. {len(frames)} of {name}")
        return Choice(index=wanted - 1, reason="asked for")
    if len(frames) == 1:
        return Choice(index=0, reason="the only one")
    filling, motion = filling_and_motion(frames, intensity)
    beats = [] if header is None else r_wave_frames(header)
    if beats:
        best = max(beats, key=lambda k: filling[k])
        return Choice(index=best, reason="the best filled at an R wave", note=_doubt(filling, best))
    own = None if header is None else header.number("RepresentativeFrameNumber")
    if own is not None and 1 <= own <= len(frames):
        index = int(own) - 1
        return Choice(
            index=index, reason="the file's representative frame",
            note=_doubt(filling, index),
        )  # fmt: skip
    full = np.flatnonzero(filling >= _FILLED_SHARE)
    index = int(full[np.argmin(motion[full])])
    return Choice(index=index, reason="the stillest of the well filled ones")


def r_wave_frames(header: Header) -> list[int]:
    """Frames (from 0) at an R wave: pointers, times with frame times, or trigger delays."""
    pointers = header.numbers("RWavePointer")
    if pointers is not None:
        return sorted({int(p) - 1 for p in pointers if 1 <= p <= header.frames})
    times = _frame_times(header)
    beats = header.numbers("RWaveTimeVector")
    if beats is not None and times is not None:
        inside = [b for b in beats if times[0] - 1e-6 <= b <= times[-1] + 1e-6]
        return sorted({int(np.argmin(np.abs(times - b))) for b in inside})
    if not header.enhanced:
        return []
    delays = [header.number("NominalCardiacTriggerDelayTime", k) for k in range(header.frames)]
    if any(d is None for d in delays):
        return []
    # The delay falls back to about zero at every R wave.
    delay = np.array([float(d or 0.0) for d in delays])
    starts = np.flatnonzero(np.diff(delay) < 0) + 1
    return [int(k) for k in starts]


def _frame_times(header: Header) -> Scalars | None:
    """(frames,) ms from the first frame; None where the file does not say."""
    steps = header.numbers("FrameTimeVector")
    if steps is not None and len(steps) == header.frames:
        return np.cumsum(steps) - steps[0]
    step = header.number("FrameTime")
    return None if not step else np.arange(header.frames, dtype=np.float64) * step


def filling_and_motion(
    frames: FrameSource, intensity: Intensity | None = None
) -> tuple[Scalars, Scalars]:
    """Contrast filling (1 where it is best) and motion of every frame.

    Filling is the mean black top-hat: dark lines narrower than a large vessel; a run in which
    vessels are bright is turned round first. What stays in all frames (spine, ribs, wires) is in
    all of them alike. Motion is the mean change to the neighbours.
    """
    small = [_small(frames.decode(k)) for k in range(len(frames))]
    pixel_mm = DEFAULT_FIELD_MM / max(small[0].shape)
    if not is_dark_run(small, pixel_mm, intensity or Intensity(kind="raw")):
        # About the middle of all counts that there are, as MONOCHROME1 is.
        top = 2.0 ** math.ceil(math.log2(max(float(p.max()) for p in small) + 1.0)) - 1.0
        small = [top - p for p in small]
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))
    hat = [cv2.morphologyEx(_level(p), cv2.MORPH_BLACKHAT, disc) for p in small]
    lines = np.array([float(h.mean()) for h in hat])
    # A run without inflow varies by less than a tenth: its noise must not decide.
    spread = max(float(np.ptp(lines)), 0.1 * float(lines.max()), 1e-12)
    filling = 1.0 - (lines.max() - lines) / spread
    change = np.array([float(np.abs(b - a).mean()) for a, b in itertools.pairwise(hat)])
    before, after = np.append(change[0], change), np.append(change, change[-1])
    return filling, 0.5 * (before + after)


def _small(picture: Array) -> Array:
    scale = min(1.0, _SIDE / max(picture.shape))
    size = (max(8, round(picture.shape[1] * scale)), max(8, round(picture.shape[0] * scale)))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def _level(small: Array) -> Array:
    level = np.log1p(small)
    return cv2.GaussianBlur(level.astype(np.float32), (0, 0), 1.0)


def _doubt(filling: Scalars, index: int) -> str | None:
    if filling[index] >= _LEAST_FILLED_SHARE:
        return None
    return (
        f"frame {index + 1} holds less contrast than frame {int(np.argmax(filling)) + 1} of the "
        "same run; see --frame"
    )
