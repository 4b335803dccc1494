"""Which frames of generated cine runs are taken: ``gcar-export frame-pairs``.

Each patient is a generated tree that beats, seen by two runs one after the other (``scenes.cine``):
other phase, heart rate, contrast and place of the patient in each, raw pictures. The chosen pair's
error is the difference of both frames' true phases, modulo whole beats, in frames of the run that
has more of them in a beat. Beside it how far the two trees are apart, and what the same choice
gives if each run chooses by itself (the stillest of the well filled frames).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from gcar_deploy.config import QualityOptions
from gcar_deploy.dicom.choose import choose_frame
from gcar_deploy.dicom.header import Header
from gcar_deploy.frames.choose import SeenRun, choose_frames
from gcar_deploy.frames.cine import Cine
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.types import Image
from gcar_export.scenes.cine import CinePair, CineRun, cine_pair

#: patients that options were chosen on
CHOSEN_ON = 900
#: frames that a pair may be apart
WITHIN_FRAMES = 1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairRow:
    """One patient.

    Attributes
    ----------
    frames : taken, from 1
    error_frames, apart_mm : of the pair that was taken
    alone_frames, alone_mm : of frames that each run chose by itself
    score, margin : as ``FramePair``
    """

    frames: tuple[int, int]
    error_frames: float
    apart_mm: float
    alone_frames: float
    alone_mm: float
    score: float
    margin: float | None


@dataclasses.dataclass(frozen=True)
class _Shown:
    """A run as ``choose_frame`` wants it."""

    run: CineRun
    header: Header | None = None

    def __len__(self) -> int:
        return len(self.run.pixels)

    def decode(self, index: int) -> Image:
        return self.run.pixels[index].astype(np.float32)


def seen_run(run: CineRun) -> SeenRun:
    """Return a generated run as the runtime reads one."""
    shown = _Shown(run)
    return SeenRun(
        cine=Cine(name="run", count=len(shown), read=lambda k: (shown.decode(k), 8, "")),
        carm=run.carm,
        intensity=Intensity(kind="raw", polarity="auto"),
    )


def rows(seed: int, patients: int) -> Iterator[PairRow]:
    """Yield what is chosen of each patient."""
    for number in range(patients):
        yield judged(cine_pair(seed, number))


def judged(made: CinePair) -> PairRow:
    """Choose frames of one patient's runs."""
    error, apart = made.phase_error() * made.frames_per_beat(), made.shape_error_mm()
    alone = tuple(choose_frame(_Shown(run), None).index for run in made.runs)
    runs = {k: seen_run(run) for k, run in enumerate(made.runs, start=1)}
    found = choose_frames(runs, {1: None, 2: None})
    pair = found[1].pair if found else None
    at = alone if pair is None else pair.chosen
    return PairRow(
        frames=(at[0] + 1, at[1] + 1), error_frames=float(error[at]), apart_mm=float(apart[at]),
        alone_frames=float(error[alone]), alone_mm=float(apart[alone]),
        score=0.0 if pair is None else pair.score, margin=None if pair is None else pair.margin,
    )  # fmt: skip


def table(found: Sequence[PairRow]) -> str:
    """Markdown: a line a patient, and how many are within a frame."""
    least = QualityOptions().good_frame_margin
    out = [
        "| patient | frames | phase error, frames | trees apart mm | score | margin | "
        "each run alone: error, frames | apart mm |",
        "|---" * 8 + "|",
    ]
    for k, row in enumerate(found, start=1):
        margin = "-" if row.margin is None else f"{row.margin:.2f}"
        out.append(
            f"| {k} | {row.frames[0]}, {row.frames[1]} | {row.error_frames:.1f} | "
            f"{row.apart_mm:.2f} | {row.score:.2f} | {margin} | {row.alone_frames:.1f} | "
            f"{row.alone_mm:.2f} |"
        )
    within = sum(row.error_frames <= WITHIN_FRAMES for row in found)
    alone = sum(row.alone_frames <= WITHIN_FRAMES for row in found)
    doubted = [row for row in found if row.margin is not None and row.margin < least]
    wrong = sum(row.error_frames > WITHIN_FRAMES for row in doubted)
    apart, apart_alone = (
        float(np.mean([getattr(row, key) for row in found])) for key in ("apart_mm", "alone_mm")
    )
    out += [
        "",
        f"Within a frame: {within} of {len(found)} (each run alone: {alone}); trees "
        f"{apart:.2f} mm apart (alone: {apart_alone:.2f}). Margin below {least:g}: "
        f"{len(doubted)}, {wrong} of them more than a frame off.",
    ]
    return "\n".join(out)
