"""Engine: a warm session for host programs; no prints, no global state, safe between threads."""

from __future__ import annotations

import dataclasses
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gcar_deploy.beside import allowed_threads
from gcar_deploy.config import PredictOptions, RunOptions, check_options
from gcar_deploy.config.ranges import Range, check_number
from gcar_deploy.errors import ModelError, RefusedError, UsageError
from gcar_deploy.files import path_of
from gcar_deploy.imaging.extract import asks_network
from gcar_deploy.imaging.net import Segmenter, load_segmenter
from gcar_deploy.inputs.drawn import Drawn
from gcar_deploy.inputs.order import Order, check_view_numbers
from gcar_deploy.inputs.pictures import Geometry, Mask, Picture, prepare
from gcar_deploy.output.bundle import check_extras
from gcar_deploy.output.folder import check_target
from gcar_deploy.predict import Predictor, load_predictor, missing_predictor
from gcar_deploy.reconstruct import reconstruct
from gcar_deploy.result import Result
from gcar_deploy.steps import OnStep
from gcar_deploy.stopwatch import OnProgress, Stopwatch

_NO_FOLDER = "out is missing: name the folder for the result (--out DIR)"


class Engine:
    """Holds the model and the options; one instance may serve many threads.

    Parameters
    ----------
    model : path of an ONNX file with its spec beside it; None for the shipped one
    threads : int, threads within one reconstruction; None for the number of cores, at most 4
    options : RunOptions; ``options.predict.predictor`` says which predictor
    session : an existing ``onnxruntime.InferenceSession`` of that model
    segmenter_model : as ``model``, of the network that finds vessels in raw pictures

    Raises
    ------
    UsageError
        An option is out of its range (``config/ranges.py``).
    ModelError
        A model given is missing, or a model is altered or unfit. Where no model is given and
        none is installed, the visual hull is thinned instead, and every result says so.
    """

    def __init__(
        self,
        model: str | Path | None = None,
        *,
        threads: int | None = None,
        options: RunOptions | None = None,
        session: Any = None,
        segmenter_model: str | Path | None = None,
    ) -> None:
        self.options = options or RunOptions()
        check_options(self.options)
        if threads is not None:
            check_number("threads", threads, int, Range(1, 256))
        self.threads = threads or min(os.cpu_count() or 1, 4)
        for key, given in (("model", model), ("segmenter_model", segmenter_model)):
            if given is not None:
                path_of(given, key, ModelError if isinstance(given, str) else UsageError)
        wanted = self.options.predict
        self._predictor = load_predictor(model, wanted, threads=self.threads, session=session)
        self._segmenter: Segmenter | None = None
        self._further: dict[str, Predictor | None] = {}
        self._lock = threading.Lock()
        self._segmenter_model = segmenter_model
        if segmenter_model is not None or self.options.imaging.segmenter == "net":
            self._needed_segmenter("net")

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
        self._needed_segmenter(self.options.imaging.segmenter)
        return float(self.reconstruct(angiograms, grid).seconds["total"])

    def _needed_segmenter(self, wanted: str) -> Segmenter | None:
        """Load the network that finds vessels once, when a picture first needs it."""
        if wanted == "classic":
            return None
        with self._lock:
            if self._segmenter is None:
                self._segmenter = load_segmenter(wanted, self.threads, self._segmenter_model)
            return self._segmenter

    def _predictor_for(self, options: PredictOptions) -> tuple[Predictor | None, tuple[str, ...]]:
        """Return the predictor that is wanted, loaded once, and a word if there is none."""
        wanted, own = options.predictor, self._predictor
        if wanted == "none":
            return None, ()
        if own is not None and wanted in ("auto", own.model.kind):
            return own, ()
        with self._lock:
            if wanted not in self._further:
                self._further[wanted] = load_predictor(None, options, threads=self.threads)
        found = self._further[wanted]
        return found, () if found is not None else (missing_predictor(wanted),)

    def reconstruct(
        self,
        views: Sequence[Picture],
        geometry: Geometry | None = None,
        *,
        masks: Mapping[int, Mask] | None = None,
        on_progress: OnProgress | None = None,
        deadline_s: float | None = None,
        cancel: Callable[[], bool] | None = None,
        on_step: OnStep | None = None,
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
            it has (``degraded``); CancelledError if there is nothing to refine by then, later by
            what lies between two questions
        cancel : callable, for instance ``threading.Event().is_set``; asked, as is the deadline,
            before each frame that is read, each stage, estimate of the pose and step of the
            refinement, and from another thread while the model runs
        on_step : told what each stage hands on, for instance ``output.step_folder.StepFolder``

        Raises
        ------
        UsageError, ImageError, GeometryError, RefusedError, CancelledError, NumericalError
        """
        if deadline_s is not None:
            check_number("deadline_s", deadline_s, float, Range(1e-9, 1e9))
        task = _Task(views, geometry, masks, {}, self.options, deadline_s)
        return self._solve(task, on_progress, cancel, on_step)

    def reconstruct_order(
        self,
        order: Order,
        *,
        on_progress: OnProgress | None = None,
        cancel: Callable[[], bool] | None = None,
        limit_s: float | None = None,
        on_step: OnStep | None = None,
    ) -> Result:
        """Reconstruct the tree of an order; what it leaves open is as this engine was set up.

        Parameters
        ----------
        order : Order; ``deliver`` does what it says of the result
        on_progress, cancel, on_step : as ``reconstruct``
        limit_s : the longest deadline that is granted

        Raises
        ------
        As ``reconstruct``, and ModelError where the order's predictor or segmenter is not there.
        """
        check_view_numbers(order)
        limits = [limit for limit in (order.deadline_s, limit_s) if limit is not None]
        options = order.options(self.options)
        deadline_s = min(limits, default=None)
        task = _Task(
            order.views, order.geometry, order.masks, order.drawn, options, deadline_s
        )  # fmt: skip
        return self._solve(task, on_progress, cancel, on_step)

    def _solve(
        self,
        task: _Task,
        on_progress: OnProgress | None,
        cancel: Callable[[], bool] | None,
        on_step: OnStep | None,
    ) -> Result:
        called = {"on_progress": on_progress, "cancel": cancel, "on_step": on_step}
        for key, given in called.items():
            if given is not None and not callable(given):
                raise UsageError(f"{key} is a {type(given).__name__}; give a function")
        watch = Stopwatch((), deadline_s=task.deadline_s, cancel=cancel)
        options = task.options
        check_options(options)
        predictor, missing = self._predictor_for(options.predict)
        angiograms, grid, notes = prepare(
            task.views, task.geometry, options, task.masks, task.drawn, watch.check
        )
        wanted = options.imaging.segmenter if asks_network(angiograms) else "classic"
        with allowed_threads(self.threads):
            found = reconstruct(
                angiograms,
                grid,
                options,
                predictor=predictor,
                segmenter=self._needed_segmenter(wanted),
                on_progress=on_progress,
                deadline_s=task.deadline_s,
                cancel=cancel,
                used_s=watch.elapsed_s,
                on_step=on_step,
            )
        return Result.of(found, (*notes, *missing, *found.notes))


@dataclasses.dataclass(frozen=True)
class _Task:
    """What is given, and how it is to be done."""

    views: Sequence[Picture]
    geometry: Geometry | None
    masks: Mapping[int, Mask] | None
    drawn: Mapping[int, Drawn]
    options: RunOptions
    deadline_s: float | None


def check_target_of(order: Order) -> Path:
    """Find out, before any work, whether the order's result can be written; return its folder.

    Raises
    ------
    UsageError
        ``out`` is missing, stands in the way or holds one of the order's files, or a further
        file needs a library that is not installed.
    """
    if order.out is None:
        raise UsageError(_NO_FOLDER)
    check_target(order.out, force=order.force, inputs=tuple(order.files.values()))
    check_extras(order.extras)
    return order.out


def deliver(result: Result, order: Order) -> Path:
    """Write the result folder that an order asks for.

    Raises
    ------
    RefusedError
        The order is strict and the result degraded.
    UsageError, GcarError
        As ``Result.save``.
    """
    if order.out is None:
        raise UsageError(_NO_FOLDER)
    if order.strict and result.status != "ok":
        raise RefusedError(f"degraded, and strict was asked for: {result.quality.sentence}")
    return result.save(order.out, force=order.force, extras=order.extras)
