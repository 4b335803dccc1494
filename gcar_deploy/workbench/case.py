"""One case on the desk: its order, its pictures, and what the last run made of it."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import secrets
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gcar_deploy.config import PictureLimits, RunOptions
from gcar_deploy.dicom.carm import unsaid
from gcar_deploy.dicom.header import is_dicom, read_header
from gcar_deploy.dicom.scene import read_run
from gcar_deploy.errors import GcarError, GeometryError, UsageError
from gcar_deploy.files import read_text
from gcar_deploy.frames.cine import Cine, is_cine, open_cine
from gcar_deploy.geometry.fields import read_json
from gcar_deploy.geometry.own_frame import OwnFrame
from gcar_deploy.geometry.scene import Scene, View, parse_scene, scene_to_json
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.chosen_frame import ChosenFrame
from gcar_deploy.imaging.own_frame import found_as_given
from gcar_deploy.imaging.polarity import with_polarity
from gcar_deploy.imaging.read import read_picture
from gcar_deploy.imaging.vessels import Vessels
from gcar_deploy.inputs.order import MAX_BYTES, Order, order_to_json, parse_order
from gcar_deploy.inputs.pictures import prepare
from gcar_deploy.result import Result
from gcar_deploy.steps import Step
from gcar_deploy.types import Array, Image

ORDER_NAME = "order.json"
RESULT_NAME = "result"
#: says that the order was refused: a result that lies beside is of an earlier one
REFUSED_NAME = "refused.txt"
#: what the page may change of an order
CORRECTIONS = (
    "edits", "regions", "landmarks", "same_branch", "ostia", "deleted_mm", "frames", "geometry",
    "pixel_spacing_mm", "sod_mm", "pose", "segmenter", "predictor", "refiner",
)  # fmt: skip


class Case:
    """One case; its order is kept in its folder after every change.

    Parameters
    ----------
    folder : existing folder of the case, for ``order.json`` and ``result``
    order : Order; files in the folder by their names, others by full paths
    names : what the user calls the views, for the page alone; empty for the names of their files

    Attributes
    ----------
    id : name of the folder
    key : unguessable, part of the address of the result's files
    order : Order
    result : of the last run that ended well, None before
    job_id : of the last run, None before
    asked, made_by : order of the last run, and of that which made the result; None before
    vessels : found by the last run, refused or not, in the order of the views; empty before
    pair_scores : numbers of two views, from 1, the lower first -> (n, m) how well each frame of
        the one goes with each of the other, 0 .. 1; empty where nobody judged pairs
    proposed : number of a view -> frame that was chosen together with that of another view
    revision : how often the order was kept
    """

    def __init__(self, folder: Path, order: Order, names: Sequence[str] = ()) -> None:
        self.folder, self.id = folder, folder.name
        self.key = secrets.token_urlsafe(16)
        # Not in the order: a result must not carry the name of a file, which may be the patient's.
        self.names = tuple(names) or tuple(path.name for path in order.views)
        self.result: Result | None = None
        self.job_id: str | None = None
        self.asked: Order | None = None
        self.made_by: Order | None = None
        self.vessels: tuple[VesselImage, ...] = ()
        self.pair_scores: dict[tuple[int, int], Array] = {}
        self.proposed: dict[int, ChosenFrame] = {}
        self._frame: OwnFrame | None = None
        self._read: tuple[str, tuple[tuple[Angiogram, ...], list[str]]] | None = None
        self._judged: tuple[tuple[Angiogram, ...], tuple[Angiogram, ...]] | None = None
        self._lock = threading.Lock()
        self._kept: str | None = None
        self.revision = 0
        self.order = self._keep(dataclasses.replace(order, out=Path(RESULT_NAME), force=True))

    @property
    def order_file(self) -> Path:
        """Where the order is kept: ``gcar run --order`` repeats the result."""
        return self.folder / ORDER_NAME

    @property
    def ready_order(self) -> Order:
        """The order with full paths."""
        return self.order.relative_to(self.folder)

    def correct(self, values: Mapping[str, Any], revision: int | None = None) -> None:
        """Replace the corrections that are given; null or nothing takes them back.

        Parameters
        ----------
        values : what is corrected -> how
        revision : of the order that whoever corrects has seen; None overwrites any

        Raises
        ------
        UsageError
            A key is no correction, its value is wrong, somebody else has corrected the case
            since, or the order cannot be kept: nothing is changed then.
        """
        for key in values:
            if key not in CORRECTIONS:
                raise UsageError(f"key {key[:40]!r} is none of {', '.join(CORRECTIONS)}")
        with self._lock:
            if revision not in (None, self.revision):
                raise UsageError(
                    "the case was corrected elsewhere since (another tab?): it is shown as it is "
                    "now; what you did last was not kept"
                )
            told = {**self.order.to_dict(), **values}
            order = parse_order({k: v for k, v in told.items() if v not in (None, [], {})})
            if isinstance(values.get("geometry"), Mapping):
                _check_geometry(values["geometry"])
            self.order = self._keep(order)

    def say_refused(self, reason: str | None) -> None:
        """Keep beside the result that the order of now has none; None where it has."""
        file = self.folder / REFUSED_NAME
        with contextlib.suppress(OSError):
            if reason is None:
                file.unlink(missing_ok=True)
            else:
                told = (
                    f"{ORDER_NAME} was refused: {reason}\n{RESULT_NAME} is of an earlier order.\n"
                )
                file.write_text(told, encoding="utf-8")

    def take_step(self, step: Step) -> None:
        """Remember what a run hands on, so that a refused one can be looked at as well."""
        if isinstance(step, OwnFrame):
            self._frame = step
        elif isinstance(step, Vessels) and self._frame is not None:
            self.vessels = found_as_given(self._frame, step.views)

    def angiograms(self) -> tuple[Angiogram, ...]:
        """Pictures with their geometry as it is told, without what was drawn in them.

        Raises
        ------
        GcarError
            They cannot be read or do not go together.
        """
        return self._prepared()[0]

    def judged(self) -> tuple[Angiogram, ...]:
        """Pictures with their polarity as a run takes it: judged of all together.

        Raises
        ------
        GcarError
            As ``angiograms``.
        """
        found, known = self.angiograms(), self._judged
        if known is None or known[0] is not found:
            self._judged = known = found, tuple(with_polarity(found))
        return known[1]

    def described(self) -> dict[str, Any]:
        """Return all that the page shows before a run, as JSON values; a problem is a sentence."""
        out: dict[str, Any] = {
            "id": self.id, "key": self.key, "revision": self.revision,
            "order": self.order.to_dict(),
            "order_file": str(self.order_file), "names": self.names,
            "views": [], "notes": [], "geometry": None, "problem": None, "sizes": None, "lacks": {},
            "job": self.job_id, "since": self.asked != self.ready_order,
            "result": self.result is not None, "stale": self.made_by != self.ready_order,
            "dicom": [is_dicom(path) or is_cine(path) for path in self.ready_order.views],
        }  # fmt: skip
        try:
            angiograms, notes = self._prepared()
            out["geometry"] = self._geometry(angiograms)
        except GcarError as error:
            out["problem"] = str(error)
            out["lacks"] = self._lacks()
            out["sizes"] = None if out["lacks"] else self._sizes()
            # What is wrong can be put right only where it is shown.
            if isinstance(self.order.geometry, Mapping):
                out["geometry"] = self.order.geometry
            return out
        out["notes"] = notes
        out["views"] = [
            {
                "id": a.view_id, "name": a.carm.clinical_name(), "rows": a.carm.rows,
                "columns": a.carm.columns, "kind": a.intensity.kind,
                "pixel_mm": a.carm.pixel_at_isocenter_mm,
            }
            for a in angiograms
        ]  # fmt: skip
        return out

    def scores_with(self, number: int) -> dict[str, list[list[float]]]:
        """Return number of another view -> scores of each frame of view ``number`` with its own."""
        out = {}
        for (a, b), scores in self.pair_scores.items():
            if number in (a, b):
                own = scores if number == a else scores.T
                out[str(b if number == a else a)] = np.round(own, 3).tolist()
        return out

    def run_of(self, number: int) -> Cine | None:
        """Return the frames of view ``number`` (from 1); None of a file with one frame.

        Raises
        ------
        UsageError
            There is no such view, or it is no run.
        """
        views = self.ready_order.views
        path = views[number - 1] if 1 <= number <= len(views) else None
        if path is None or not (is_dicom(path) or is_cine(path)):
            raise UsageError(f"view {number} is no run")
        return _frames(path)

    def bare(self, number: int) -> Image:
        """(rows, cols) counts of view ``number`` (from 1), also where its geometry is unknown.

        Of a run it is the middle frame.

        Raises
        ------
        GcarError
            There is no such view, or it cannot be read.
        """
        views = self.ready_order.views
        if not 1 <= number <= len(views):
            raise UsageError(f"view {number}: there are {len(views)}")
        path = views[number - 1]
        run = _frames(path)
        if run is not None:
            return run.decode(len(run) // 2)
        if is_dicom(path):
            return read_run(path, RunOptions().dicom).pixels
        return read_picture(path, PictureLimits())[0]

    def _prepared(self) -> tuple[tuple[Angiogram, ...], list[str]]:
        order = self.ready_order
        # Only what tells how the pictures are read: drawing must not read them again.
        what = json.dumps({k: v for k, v in order.to_dict().items() if k in _READING})
        read = self._read  # other threads may set it at any time
        if read is None or read[0] != what:
            found, _, notes = prepare(
                order.views, order.geometry, order.options(RunOptions()), order.masks
            )
            self._read = read = what, (tuple(found), notes)
            self._keep_pairs(found)
        return read[1]

    def _keep_pairs(self, angiograms: Sequence[Angiogram]) -> None:
        """Remember how the frames of two runs go together, also when one is then chosen by hand."""
        for k, angiogram in enumerate(angiograms, start=1):
            frame = angiogram.frame
            if frame is None or frame.pair is None or frame.partner is None:
                continue
            self.proposed[k] = frame
            low, high = sorted((k, frame.partner))
            self.pair_scores[low, high] = np.clip(frame.pair.scores, 0.0, 1.0)

    def _sizes(self) -> list[tuple[int, int]] | None:
        """(rows, columns) of pictures whose geometry nobody tells; None where it is told."""
        if self.order.geometry is not None:
            return None
        try:
            found = [self.bare(k + 1) for k in range(len(self.order.views))]
        except GcarError:
            return None
        return [(picture.shape[0], picture.shape[1]) for picture in found]

    def _lacks(self) -> dict[str, list[int]]:
        """Key of the order -> numbers of the DICOM views (from 1) whose headers need it."""
        out: dict[str, list[int]] = {}
        views = self.ready_order.views
        if self.order.geometry is not None or not all(map(is_dicom, views)):
            return out
        with contextlib.suppress(GcarError):
            for number, path in enumerate(views, start=1):
                for key in unsaid(read_header(path)):
                    if getattr(self.order, key) is None:
                        out.setdefault(key, []).append(number)
        return out

    def _geometry(self, angiograms: tuple[Angiogram, ...]) -> Any:
        told = self.ready_order.geometry
        if isinstance(told, Mapping):
            return told
        if isinstance(told, Path):
            return read_json(read_text(told, 64 * 1024))
        views = tuple(View(id=a.view_id, carm=a.carm, intensity=a.intensity) for a in angiograms)
        return json.loads(scene_to_json(Scene(views=views)))

    def _keep(self, order: Order) -> Order:
        """Write the order into the folder, unless another program did so since; return it."""
        drawn_on = order.relative_to(self.folder).with_drawn_on().drawn_on
        order = dataclasses.replace(order, drawn_on=drawn_on)
        text, file = order_to_json(order), self.order_file
        if len(text) > MAX_BYTES:
            raise UsageError(
                f"{ORDER_NAME} would be larger than the {MAX_BYTES >> 20} MiB that are read: take "
                "some of what was drawn back"
            )
        new = file.with_name(ORDER_NAME + ".new")
        try:
            if self._kept is not None and file.read_text(encoding="utf-8") != self._kept:
                raise UsageError(
                    f"{file} was changed by another program: open the case again to go on"
                )
            new.write_text(text, encoding="utf-8")
            new.replace(file)
        except OSError as error:
            raise UsageError(f"{file} cannot be written ({error.strerror}): not kept") from None
        self._kept = text
        self.revision += 1
        return order


#: keys of an order that tell how its pictures are read
_READING = ("views", "geometry", "masks", "frames", "pixel_spacing_mm", "sod_mm", "allow_rescale")


def _check_geometry(told: Mapping[str, Any]) -> None:
    """Refuse a geometry that no picture could be read with: the page would show nothing."""
    try:
        parse_scene(json.dumps(told), "geometry")
    except GeometryError as error:
        raise UsageError(str(error)) from None


def _frames(path: Path) -> Cine | None:
    """Frames of a run as its file is now; None of a file with one frame."""
    try:
        told = path.stat()
    except OSError:
        return _opened(path, 0, 0)  # says what is wrong with it
    return _opened(path, told.st_mtime_ns, told.st_size)


@functools.lru_cache(maxsize=8)
def _opened(path: Path, changed_ns: int, size: int) -> Cine | None:
    # One for each state of the file: another may be put in its place.
    # Frames are only looked at here: a run of the case says whether numbers below 0 are noise.
    return open_cine(path, RunOptions(), subtracted=True)
