"""Engine: a warm session for host programs; no prints, no global state, safe between threads."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from gcar_deploy.config import PictureLimits, RunOptions, check_options
from gcar_deploy.config.ranges import Range, check_number
from gcar_deploy.dicom.header import is_dicom
from gcar_deploy.dicom.scene import as_angiogram, read_run, read_views, wanted_frames
from gcar_deploy.errors import GeometryError, ImageError, UsageError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Scene, View, load_scene, match_picture, parse_scene
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.imaging.extract import above_half, asks_network
from gcar_deploy.imaging.net import Segmenter, check_segmenter, load_segmenter
from gcar_deploy.imaging.read import read_picture
from gcar_deploy.predict import load_predictor, missing_predictor
from gcar_deploy.reconstruct import reconstruct
from gcar_deploy.result import Result
from gcar_deploy.stopwatch import OnProgress

#: a file, an array of counts, or a picture that already knows its C-arm
Picture: TypeAlias = "str | Path | np.ndarray | Angiogram"
#: geom.json as a file, its content, a Scene; or only a Grid where every picture is an Angiogram
Geometry: TypeAlias = "str | Path | Mapping[str, Any] | Scene | Grid"
_DEPTHS = {"uint8": 8, "uint16": 16, "float32": 32, "float64": 64}


class Engine:
    """Holds the model and the options; one instance may serve many threads.

    Parameters
    ----------
    model : path of an ONNX file with its spec beside it; None for the shipped one
    threads : int, threads within one inference; None for the number of cores, at most 4
    options : RunOptions; ``options.predict.predictor`` says which predictor
    session : an existing ``onnxruntime.InferenceSession`` of that model

    Raises
    ------
    UsageError
        An option is out of its range (``config/ranges.py``).
    ModelError
        The model given is missing, or a model is altered or unfit. Where no model is given and
        none is installed, the visual hull is thinned instead, and every result says so.
    """

    def __init__(
        self,
        model: str | Path | None = None,
        *,
        threads: int | None = None,
        options: RunOptions | None = None,
        session: Any = None,
    ) -> None:
        self.options = options or RunOptions()
        check_options(self.options)
        if threads is not None:
            check_number("threads", threads, int, Range(1, 256))
        self.threads = threads or min(os.cpu_count() or 1, 4)
        wanted = self.options.predict
        self._predictor = load_predictor(model, wanted, threads=self.threads, session=session)
        self._notes: tuple[str, ...] = ()
        if self._predictor is None and wanted.predictor != "none":
            self._notes = (missing_predictor(wanted.predictor),)
        check_segmenter(self.options.imaging.segmenter)
        self._segmenter: Segmenter | None = None
        self._segmenter_lock = threading.Lock()
        if self.options.imaging.segmenter == "net":
            self._needed_segmenter()

    @property
    def model(self) -> Mapping[str, str] | None:
        """Name and SHA-256 of the loaded model; None without one."""
        if self._predictor is None:
            return None
        return self._predictor.model.label

    def warmup(self) -> float:
        """Run a small generated case once, so that the next call finds everything loaded.

        Returns
        -------
        seconds that it took
        """
        from gcar_deploy.selftest import tiny_case

        angiograms, grid, _ = tiny_case()
        self._needed_segmenter()
        return float(self.reconstruct(angiograms, grid).seconds["total"])

    def _needed_segmenter(self) -> Segmenter | None:
        """Load the network that finds vessels once, when a picture first needs it."""
        with self._segmenter_lock:
            if self._segmenter is None:
                self._segmenter = load_segmenter(self.options.imaging.segmenter, self.threads)
            return self._segmenter

    def reconstruct(
        self,
        views: Sequence[Picture],
        geometry: Geometry | None = None,
        *,
        masks: Mapping[int, str | Path | np.ndarray] | None = None,
        on_progress: OnProgress | None = None,
        deadline_s: float | None = None,
        cancel: Callable[[], bool] | None = None,
    ) -> Result:
        """Reconstruct one tree.

        Parameters
        ----------
        views : 2 or more pictures, in the order of the geometry's views
        geometry : where they were taken from; None where DICOM headers say it
        masks : number of the view, from 1 -> vessel mask (picture of its size), which wins over
            what would be found in the pixels
        on_progress : called with (stage, share of the work done) from the calling thread
        deadline_s : seconds that the call may take: the refinement ends early enough with what
            it has (``degraded``); CancelledError if there is nothing to refine by then
        cancel : callable, for instance ``threading.Event().is_set``; also asked from another
            thread while the model runs; ends within one step of the refinement

        Raises
        ------
        UsageError, ImageError, GeometryError, RefusedError, CancelledError, NumericalError
        """
        if deadline_s is not None:
            check_number("deadline_s", deadline_s, float, Range(1e-9, 1e9))
        started = time.perf_counter()
        angiograms, grid, notes = prepare(views, geometry, self.options)
        angiograms = with_masks(angiograms, masks or {}, self.options.imaging.limits)
        notes += [f"view {number}: the vessel mask is the user's" for number in masks or {}]
        found = reconstruct(
            angiograms,
            grid,
            self.options,
            predictor=self._predictor,
            segmenter=self._needed_segmenter() if asks_network(angiograms) else None,
            on_progress=on_progress,
            deadline_s=deadline_s,
            cancel=cancel,
            used_s=time.perf_counter() - started,
        )
        return Result.of(found, (*notes, *self._notes, *found.notes))


def prepare(
    views: Sequence[Picture], geometry: Geometry | None, options: RunOptions
) -> tuple[list[Angiogram], Grid, list[str]]:
    """Pair pictures with their views.

    Returns
    -------
    angiograms, grid asked for, sentences worth telling

    Raises
    ------
    UsageError
        Fewer than two pictures.
    GeometryError
        Not as many pictures as views, or sizes at odds.
    ImageError
        A picture cannot be read.
    """
    if len(views) < 2:
        raise UsageError(f"{len(views)} picture given; two or more are needed")
    if geometry is None:
        return _from_headers(views, options)
    given = [view for view in views if isinstance(view, Angiogram)]
    if isinstance(geometry, Grid):
        if len(given) != len(views):
            raise UsageError("a Grid alone tells no geometry: give a scene, or Angiograms")
        return given, geometry, []
    scene = _scene(geometry)
    if len(scene.views) != len(views):
        raise GeometryError(
            f"{len(views)} pictures are given, but the geometry has {len(scene.views)} views"
        )
    notes = list(scene.warnings)
    angiograms = []
    frames = _frames_for(views, options)
    for picture, view in zip(views, scene.views, strict=True):
        if isinstance(picture, Angiogram):
            angiograms.append(picture)
            continue
        if isinstance(picture, (str, Path)) and is_dicom(picture):
            run = read_run(picture, options.dicom, frames.pop(0))
            carm = _matched(view, run.pixels.shape, notes)
            angiograms.append(as_angiogram(run, dataclasses.replace(view, carm=carm)))
            notes += [f"view {view.id}: {note}" for note in run.notes]
            continue
        if isinstance(picture, np.ndarray):
            pixels, depth, sha256 = _from_array(view.id, picture, options.imaging.limits)
        else:
            pixels, depth, sha256 = read_picture(picture, options.imaging.limits)
        carm = _matched(view, pixels.shape, notes)
        angiograms.append(
            Angiogram(
                view_id=view.id,
                carm=carm,
                pixels=pixels,
                bit_depth=depth,
                intensity=view.intensity,
                sha256=sha256,
            )
        )
    return angiograms, scene.volume_grid(), notes


def with_masks(
    angiograms: Sequence[Angiogram],
    masks: Mapping[int, str | Path | np.ndarray],
    limits: PictureLimits,
) -> list[Angiogram]:
    """Give pictures the user's vessel masks.

    Raises
    ------
    UsageError
        There is no view of that number.
    ImageError
        A mask cannot be read, has another size than its picture, or no vessel.
    """
    out = list(angiograms)
    for number, given in masks.items():
        if not 1 <= number <= len(out):
            raise UsageError(f"mask {number}: there are views 1 .. {len(out)}")
        array = given if isinstance(given, np.ndarray) else read_picture(given, limits)[0]
        shape = out[number - 1].pixels.shape
        if array.shape != shape:
            raise ImageError(
                f"mask {number} has {array.shape} (rows, columns), its picture {shape}"
            )
        mask = above_half(array)
        if not mask.any() or mask.mean() > 0.9:
            raise ImageError(f"mask {number} marks {mask.mean():.0%} of the picture as vessel")
        out[number - 1] = dataclasses.replace(out[number - 1], mask=mask)
    return out


def _from_headers(
    views: Sequence[Picture], options: RunOptions
) -> tuple[list[Angiogram], Grid, list[str]]:
    """Pictures whose own headers tell the geometry: DICOM XA alone."""
    paths = [view for view in views if isinstance(view, (str, Path))]
    for path in paths:
        if not is_dicom(path):
            raise UsageError(
                f"{Path(path).name} is no DICOM file: its geometry is needed (--geom geom.json)"
            )
    if len(paths) != len(views):
        raise UsageError("pictures in memory tell no geometry: give a scene")
    angiograms, scene, notes = read_views(paths, options.dicom)
    return angiograms, scene.volume_grid(), notes


def _frames_for(views: Sequence[Picture], options: RunOptions) -> list[int | None]:
    """Frame of each DICOM file among the pictures, in their order."""
    runs = sum(isinstance(view, (str, Path)) and is_dicom(view) for view in views)
    return list(wanted_frames(options.dicom, runs)) if runs else []


def _matched(view: View, shape: tuple[int, ...], notes: list[str]) -> CArm:
    """Fit a view to the size of its picture; what was rescaled is added to ``notes``."""
    try:
        carm, note = match_picture(view.carm, shape[0], shape[1])
    except GeometryError as error:
        raise GeometryError(f"view {view.id}: {error}") from None
    if note:
        notes.append(f"view {view.id}: {note}")
    return carm


def _from_array(
    view_id: str, array: np.ndarray, limits: PictureLimits
) -> tuple[np.ndarray, int, str]:
    """Like ``read_picture`` for counts that are in memory already."""
    depth = _DEPTHS.get(array.dtype.name)
    if depth is None or array.ndim != 2:
        raise ImageError(
            f"view {view_id}: an array of {array.dtype} with {array.ndim} dimensions; give "
            "(rows, columns) of uint8, uint16, float32 or float64"
        )
    if not limits.min_side <= min(array.shape) <= max(array.shape) <= limits.max_side:
        raise ImageError(
            f"view {view_id}: {array.shape[0]} x {array.shape[1]} pixels; each side must be "
            f"{limits.min_side} .. {limits.max_side}"
        )
    if not (np.isfinite(array).all() and array.min() >= 0):
        raise ImageError(f"view {view_id}: grey values must be finite and not negative")
    sha256 = hashlib.sha256(f"{array.dtype.name}{array.shape}".encode())
    sha256.update(np.ascontiguousarray(array).tobytes())
    return array.astype(np.float32), depth, sha256.hexdigest()


def _scene(geometry: Geometry) -> Scene:
    if isinstance(geometry, Scene):
        return geometry
    if isinstance(geometry, Mapping):
        import json

        try:
            return parse_scene(json.dumps(dict(geometry)), "geometry")
        except (TypeError, ValueError) as error:
            raise GeometryError(f"geometry cannot be written as JSON: {error}") from None
    if isinstance(geometry, (str, Path)):
        return load_scene(geometry)
    raise UsageError(f"geometry is a {type(geometry).__name__}; give a path, dict or Scene")
