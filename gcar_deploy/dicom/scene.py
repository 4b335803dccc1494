"""DICOM runs to pictures that know their C-arm, and to a scene file."""

from __future__ import annotations

import dataclasses
import itertools
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from gcar_deploy.config import DicomOptions
from gcar_deploy.dicom.carm import frame_carm, is_flipped
from gcar_deploy.dicom.choose import Choice, choose_frame
from gcar_deploy.dicom.frames import Frames
from gcar_deploy.dicom.header import PATIENT, SYNTAXES, Header, read_header, tag, told_apart
from gcar_deploy.dicom.shutter import open_field
from gcar_deploy.errors import GeometryError, RefusedError, UsageError
from gcar_deploy.geometry.scene import Intensity, Scene, View, parse_scene, scene_to_json
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.imaging.chosen_frame import ChosenFrame
from gcar_deploy.types import Image, Mask

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One chosen frame of a run, before it is paired with a geometry.

    Attributes
    ----------
    header : Header
    index : int, the frame, from 0
    pixels : (rows, cols) float32 counts; a stored mirror image is turned back
    valid : (rows, cols) bool or None, outside shutters and collimator there is no picture
    intensity : Intensity
    notes : ends of sentences; no file name, for they stand in results
    chosen : the frame where it was chosen among several, None where it was asked for
    """

    header: Header
    index: int
    pixels: Image
    valid: Mask | None
    intensity: Intensity
    notes: tuple[str, ...]
    chosen: ChosenFrame | None = None


def read_run(
    path: str | Path,
    options: DicomOptions,
    wanted: int | ChosenFrame | None = None,
    check: Callable[[], None] | None = None,
) -> Run:
    """Read a run and choose its frame.

    Parameters
    ----------
    wanted : from 1, None to choose, or what was chosen already
    check : called before each frame is read; what it raises ends the reading

    Raises
    ------
    ImageError, UsageError, GeometryError
    """
    header = read_header(path, options.limits)
    frames = Frames(header, check)
    if isinstance(wanted, ChosenFrame):
        chosen: ChosenFrame | None = wanted
        choice = Choice(index=wanted.number - 1, reason=wanted.reason)
    else:
        choice = choose_frame(frames, wanted, intensity=intensity_of(header, 0)[0])
        chosen = None
        if wanted is None and len(frames) > 1:
            chosen = ChosenFrame(number=choice.index + 1, of=len(frames), reason=choice.reason)
    pixels = frames.decode(choice.index)
    valid = open_field(header, choice.index)
    if is_flipped(header, choice.index):
        pixels = np.ascontiguousarray(pixels[:, ::-1])
        valid = None if valid is None else np.ascontiguousarray(valid[:, ::-1])
    intensity, notes = intensity_of(header, choice.index)
    if choice.reason != "the only one":
        notes.insert(0, f"frame {choice.index + 1} of {len(frames)}: {choice.reason}")
    notes += [choice.note] if choice.note else []
    notes += _warnings(header, choice.index)
    return Run(
        header=header, index=choice.index, pixels=pixels, valid=valid, intensity=intensity,
        notes=tuple(notes), chosen=chosen,
    )  # fmt: skip


def read_views(
    paths: Sequence[str | Path],
    options: DicomOptions,
    chosen: Mapping[int, ChosenFrame] | None = None,
    check: Callable[[], None] | None = None,
) -> tuple[list[Angiogram], Scene, list[str]]:
    """Read runs whose headers tell the whole geometry.

    Parameters
    ----------
    paths : two or more files
    options : DicomOptions; ``frames`` has one entry, or one for each file
    chosen : number of the view, from 1 -> its frame, where that was chosen already
    check : as ``read_run``

    Returns
    -------
    angiograms, their scene, sentences worth telling

    Raises
    ------
    ImageError, GeometryError, UsageError
    """
    wanted = wanted_frames(options, len(paths))
    angiograms, views, notes, headers = [], [], [], {}
    for number, (path, frame) in enumerate(zip(paths, wanted, strict=True), start=1):
        run = read_run(path, options, (chosen or {}).get(number, frame), check)
        carm, said = frame_carm(run.header, run.index, options)
        # By number: a result must not carry the name of a file, which may be the patient's.
        notes += [f"view {number}: {note}" for note in (*run.notes, *said)]
        view = View(id=str(number), carm=carm, intensity=run.intensity)
        views.append(view)
        angiograms.append(as_angiogram(run, view))
        headers[number] = run.header
    notes += check_origin(headers)
    # The one set of checks that every scene passes, whatever it was written in.
    scene = parse_scene(scene_to_json(Scene(views=tuple(views))), "the geometry in the headers")
    return angiograms, scene, [*notes, *scene.warnings]


def check_origin(headers: Mapping[int, Header]) -> list[str]:
    """Hold against each other whom the runs show.

    Parameters
    ----------
    headers : number of the view, from 1 -> its header; values of it are not repeated

    Returns
    -------
    notes : of runs of one patient, whether they are of different studies

    Raises
    ------
    RefusedError
        They are of different patients.
    """
    notes = []
    for a, b in itertools.combinations(sorted(headers), 2):
        one, other = (
            {key: _text(headers[k], key) for key in (*PATIENT, "StudyInstanceUID")} for k in (a, b)
        )
        differ = told_apart(one, other)
        patient = [key for key in differ if key in PATIENT]
        if patient:
            raise RefusedError(
                f"the headers of views {a} and {b} tell of different patients "
                f"({', '.join(map(tag, patient))})"
            )
        if differ:
            notes.append(f"views {a} and {b} are of different studies")
    return notes


def _text(header: Header, keyword: str) -> str:
    try:
        return header.text(keyword)
    except GeometryError:
        return ""  # damaged: it tells nothing


def as_angiogram(run: Run, view: View) -> Angiogram:
    """Pair a frame with its view."""
    return Angiogram(
        view_id=view.id, carm=view.carm, pixels=run.pixels, bit_depth=run.header.bits,
        intensity=view.intensity, sha256=run.header.sha256, valid=run.valid, frame=run.chosen,
    )  # fmt: skip


def wanted_frames(options: DicomOptions, runs: int) -> tuple[int | None, ...]:
    """One frame number (from 1) or None for each run.

    Raises
    ------
    UsageError
        Neither one entry nor one for each run.
    """
    if len(options.frames) == 1:
        return options.frames * runs
    if len(options.frames) != runs:
        raise UsageError(
            f"--frame names {len(options.frames)} frames for {runs} DICOM files or runs; "
            "give one, or one for each file"
        )
    return options.frames


def intensity_of(header: Header, frame: int) -> tuple[Intensity, list[str]]:
    """Read what the counts mean (PS3.3 C.8.11.3.1.2), from the frame as ``Frames`` gives it."""
    relation = header.text("PixelIntensityRelationship", frame)
    sign = header.number("PixelIntensityRelationshipSign", frame)
    if header.text("PhotometricInterpretation") == "MONOCHROME1" and sign:
        sign = -sign  # the counts were turned round
    # +1: more counts, more X-rays reached the detector; vessels are dark.
    polarity = "auto" if not sign else "dark" if sign > 0 else "bright"
    if relation == "LOG":
        return Intensity(kind="attenuation", polarity=polarity), []
    notes = []
    if relation != "LIN":
        what = "display-processed (DISP)" if relation == "DISP" else f"called {relation or 'none'}"
        notes.append(
            f"grey values are {what}: path lengths are estimated from their contrast and the "
            "widths of the vessels, under the law that fits the display"
        )
    return Intensity(kind="raw", polarity=polarity), notes


def _warnings(header: Header, frame: int) -> list[str]:
    notes = []
    if header.find("MaskSubtractionSequence") is not None:
        notes.append(f"{tag('MaskSubtractionSequence')} is not applied: the frame is used as is")
    image_type = header.find("ImageType", frame) or ()
    if any("SUBTRACT" in str(word).upper() for word in image_type):
        notes.append("holds subtracted pictures")
    if header.text("BurnedInAnnotation") == "YES":
        notes.append("has text burned into its pixels, which may be taken for vessel")
    if SYNTAXES[header.syntax] or header.text("LossyImageCompression") == "01":
        notes.append("was compressed with loss")
    if header.find("ModalityLUTSequence", frame) is not None:
        notes.append(f"{tag('ModalityLUTSequence')} is not applied")
    if header.text("TableMotion") == "DYNAMIC":
        notes.append("the table moved during the run: its position in this frame is not known")
    for note in notes:
        _log.debug("%s", note)
    return notes
