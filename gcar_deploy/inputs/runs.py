"""Views that are runs of several frames: which frame of each is taken."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from gcar_deploy.config import RunOptions
from gcar_deploy.dicom.carm import frame_carm
from gcar_deploy.dicom.choose import choose_frame
from gcar_deploy.dicom.header import is_dicom
from gcar_deploy.dicom.scene import intensity_of, wanted_frames
from gcar_deploy.errors import CancelledError, GcarError, GeometryError, UsageError
from gcar_deploy.frames.bare import bare_before
from gcar_deploy.frames.choose import (
    LEAST_FRAMES,
    SeenRun,
    choose_frames,
    masses_of,
    pair_of,
    stands_still,
)
from gcar_deploy.frames.cine import Cine, is_cine, open_cine
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.scene import Intensity, Scene, match_picture
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.imaging.chosen_frame import ChosenFrame, FramePair
from gcar_deploy.imaging.extract import asks_network
from gcar_deploy.imaging.read import check_opens
from gcar_deploy.types import Image

#: told the share done, 0 .. 1
Report: TypeAlias = Callable[[float], None]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Runs:
    """The runs among the views; numbers of views count from 1.

    Attributes
    ----------
    cines : number of the view -> run of several frames
    wanted : number of the view -> frame that is asked for, from 1, None to choose; single-frame
        DICOM files too
    """

    cines: Mapping[int, Cine]
    wanted: Mapping[int, int | None]

    def frame(
        self, number: int, chosen: Mapping[int, ChosenFrame], intensity: Intensity
    ) -> tuple[Image, int, str, ChosenFrame | None]:
        """Read the frame of a run that is no DICOM file.

        Returns
        -------
        pixels, bit depth, SHA-256 of its file, and how it was chosen (None: asked for)
        """
        cine, asked = self.cines[number], self.wanted[number]
        frame = chosen.get(number)
        if frame is None:
            choice = choose_frame(cine, asked, cine.name, intensity)
            if asked is None and len(cine) > 1:
                frame = ChosenFrame(number=choice.index + 1, of=len(cine), reason=choice.reason)
            return (*cine.read(choice.index), frame)
        return (*cine.read(frame.number - 1), frame)


def find_runs(
    views: Sequence[Any],
    options: RunOptions,
    scene: Scene | None = None,
    check: Callable[[], None] | None = None,
) -> Runs:
    """Find the runs among the views, and what is asked of them.

    Parameters
    ----------
    views : files, or pictures in memory
    options : RunOptions
    scene : what the views' counts mean, a view each; None where headers tell it
    check : called before each frame is read; what it raises ends the reading

    Raises
    ------
    ImageError, UsageError
    """
    files = {k: view for k, view in enumerate(views, start=1) if isinstance(view, (str, Path))}
    runs = [k for k, path in files.items() if is_dicom(path) or is_cine(path)]
    wanted = dict(zip(runs, wanted_frames(options.dicom, len(runs)), strict=True)) if runs else {}
    opened = {
        k: open_cine(
            files[k], options, check=check,
            subtracted=scene is not None and scene.views[k - 1].intensity.subtracted,
        )
        for k in runs
    }  # fmt: skip
    return Runs(cines={k: c for k, c in opened.items() if c is not None}, wanted=wanted)


def together(runs: Runs, seen: Mapping[int, SeenRun]) -> dict[int, ChosenFrame]:
    """Choose the frames of the runs such that they go together.

    Returns
    -------
    number of the view -> frame; none where nothing is to be chosen, or nothing moves
    """
    if not _chooses(runs.wanted):
        return {}
    return choose_frames(seen, {k: runs.wanted[k] for k in seen})


def with_bare(
    angiograms: Sequence[Angiogram], runs: Runs, seen: Mapping[int, SeenRun]
) -> tuple[list[Angiogram], list[str]]:
    """Give pictures the frames of their runs before contrast came, and say which these are.

    Parameters
    ----------
    angiograms : of all views, frames of runs among them
    seen : number of the view, from 1 -> its run, where the C-arm stood still
    """
    out, notes = list(angiograms), []
    for k, run in seen.items():
        own = out[k - 1]
        number = runs.wanted[k] if own.frame is None else own.frame.number
        frames = bare_before(run, number - 1) if number and asks_network([own]) else ()
        if frames:
            out[k - 1] = dataclasses.replace(own, bare=tuple(map(run.cine.decode, frames)))
            notes.append(
                f"view {own.view_id}: frames {frames[0] + 1} .. {frames[-1] + 1} hold no contrast "
                "yet; lines that stand in them are no vessels"
            )
    return out, notes


def seen_runs(runs: Runs, scene: Scene | None, options: RunOptions) -> dict[int, SeenRun]:
    """Pair runs with their C-arms; those whose C-arm moves, or is not known, are left out."""
    out = {}
    for k, cine in runs.cines.items():
        try:
            found = _seen(k, cine, scene, options)
        except CancelledError:
            raise
        except GcarError:
            continue  # whoever reads the frame that is taken says what is wrong
        if found is not None:
            out[k] = found
    return out


def compared(
    views: Sequence[str | Path], geometry: Scene | None, options: RunOptions,
    report: Report | None = None,
) -> tuple[FramePair, tuple[SeenRun, SeenRun], dict[str, bool]]:  # fmt: skip
    """Hold the frames of two runs against each other, whether they beat or not.

    Returns
    -------
    the pair that ``together`` takes, or, where it takes none, the frames that the runs choose each
    by itself (without a margin); the runs; number of the view -> whether it shows a heartbeat

    Raises
    ------
    UsageError
        One of them is no run of several frames.
    GeometryError
        A C-arm is not known, or moved during its run.
    """
    runs = find_runs(views, options, geometry)
    for k, view in enumerate(views, start=1):
        if k not in runs.cines:
            check_opens(view)
            raise UsageError(f"{Path(view).name} is no run of several frames")
    first, second = (_needed(k, runs, geometry, options) for k in (1, 2))
    a = masses_of(first, None if report is None else lambda share: report(0.5 * share))
    b = masses_of(second, None if report is None else lambda share: report(0.5 + 0.5 * share))
    for run, masses in ((first, a), (second, b)):
        if not masses.filling.any():
            raise UsageError(f"{run.cine.name}: nothing in it moves, and no contrast arrives")
    wanted = runs.wanted[1], runs.wanted[2]
    pair = pair_of(first, second, a, b, wanted)
    beats = {
        str(k): masses.beats and len(run.cine) >= LEAST_FRAMES
        for k, (run, masses) in enumerate(((first, a), (second, b)), start=1)
    }
    if not all(beats.values()):
        i, j = (
            choose_frame(run.cine, frame, run.cine.name, run.intensity).index
            for run, frame in zip((first, second), wanted, strict=True)
        )
        pair = dataclasses.replace(pair, chosen=(i, j), margin=None)
    return pair, (first, second), beats


def _needed(k: int, runs: Runs, scene: Scene | None, options: RunOptions) -> SeenRun:
    found = _seen(k, runs.cines[k], scene, options)
    if found is None:
        raise GeometryError(
            f"{runs.cines[k].name}: its C-arm moved during the run, or its angles are not known; "
            "frames cannot be compared"
        )
    return found


def _seen(k: int, cine: Cine, scene: Scene | None, options: RunOptions) -> SeenRun | None:
    if scene is not None:
        view = scene.views[k - 1]
        rows, columns = cine.decode(0).shape
        carm, _ = match_picture(
            view.carm, rows, columns, allow_rescale=options.imaging.allow_rescale
        )
        return SeenRun(cine=cine, carm=carm, intensity=view.intensity)
    header = cine.header
    if header is None:
        raise UsageError(f"{cine.name} is no DICOM file: its geometry is needed (--geom geom.json)")

    def carm_of(frame: int) -> CArm:
        return frame_carm(header, frame, options.dicom)[0]

    if not stands_still(carm_of, len(cine)):
        carm_of(0)  # raises what is missing
        return None
    return SeenRun(cine=cine, carm=carm_of(0), intensity=intensity_of(header, 0)[0])


def _chooses(wanted: Mapping[int, int | None]) -> bool:
    return len(wanted) > 1 and any(frame is None for frame in wanted.values())
