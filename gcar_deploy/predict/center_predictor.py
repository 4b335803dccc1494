"""The Gaussian centre predictors through ONNX Runtime: only this file of the room imports it."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import onnxruntime as ort

from gcar_deploy.errors import CancelledError, ModelError, NumericalError
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.models.golden import check_golden
from gcar_deploy.models.spec import ModelFile
from gcar_deploy.predict.center_map import OUTPUTS, ViewCenters, decode, net_picture
from gcar_deploy.predict.encoding import Encoded, flat_inputs, input_names
from gcar_deploy.predict.hull import Candidates
from gcar_deploy.types import Array, Image

#: how often a running inference is asked whether it should end, seconds
WATCH_S = 0.02


class _Warm:
    """A warm session of one model; safe to share between threads.

    Parameters
    ----------
    model : ModelFile, as ``read_model`` returns it
    threads : int, within one inference; spinning is off, so idle threads cost nothing
    session : an existing ``onnxruntime.InferenceSession`` of the same model, optional
    """

    def __init__(
        self, model: ModelFile, *, threads: int = 2, session: ort.InferenceSession | None = None
    ) -> None:
        self.model = model
        if session is None:
            session = _open(model, threads)
            self._check_inputs(session)
        self._session = session
        if model.golden is not None:
            self.check_golden()

    def input_names(self) -> list[str]:
        """Names of the graph's inputs."""
        raise NotImplementedError

    def _check_inputs(self, session: Any) -> None:
        found = [node.name for node in session.get_inputs()]
        if sorted(found) != sorted(self.input_names()) or not session.get_outputs():
            raise ModelError(f"model {self.model.name} has other inputs than this version gives")

    def check_golden(self) -> float | None:
        """Run the model's golden case again; return the largest difference, None without one.

        Raises
        ------
        ModelError
            It answers differently from the day it was made.
        """
        if self.model.golden is None:
            return None
        return check_golden(self.model.name, self.model.golden, self._run, self.model.limits)

    def answers(self, inputs: Mapping[str, Array]) -> dict[str, Array]:
        """Run the graph on named inputs; return its outputs by name."""
        names = [node.name for node in self._session.get_outputs()]
        return dict(zip(names, self._run(names, inputs), strict=True))

    def _run(
        self, outputs: Sequence[str] | None, feed: Mapping[str, Array], run_options: Any = None
    ) -> list[Array]:
        try:
            found: list[Array] = self._session.run(outputs, dict(feed), run_options)
        except Exception as error:  # noqa: BLE001 - ONNX Runtime's errors share no base class
            if getattr(run_options, "terminate", False):
                raise CancelledError("cancelled while the model ran") from None
            raise ModelError(f"model {self.model.name} fails: {_first_line(error)}") from None
        return found


class CenterPredictor(_Warm):
    """The multi-view predictor. Takes what ``_Warm`` takes."""

    def input_names(self) -> list[str]:
        """Names of the graph's inputs."""
        return input_names()

    def predict(
        self,
        candidates: Candidates,
        encoded: Encoded,
        should_stop: Callable[[], bool] | None = None,
    ) -> CenterPoints:
        """Judge every candidate.

        Parameters
        ----------
        candidates : Candidates (n points)
        encoded : Encoded, from ``encode`` with the same candidates
        should_stop : asked every ``WATCH_S`` from another thread; True ends a running inference

        Returns
        -------
        CenterPoints
            All n points with confidence, radius and the offset to the expected centreline.

        Raises
        ------
        ModelError, NumericalError
            The model cannot run on these inputs; it returned values that are not finite.
        CancelledError
            ``should_stop`` said so.
        """
        feed = dict(zip(input_names(), flat_inputs(encoded), strict=True))
        with _watched(should_stop) as run_options:
            out = self._run(None, feed, run_options)[0]
        if out.shape != (len(candidates), 5) or not np.isfinite(out).all():
            raise NumericalError(f"model {self.model.name} returned values that are not finite")
        h = candidates.spacing_mm
        return CenterPoints(
            points_mm=candidates.points_mm,
            confidence=out[:, 0].astype(np.float64),
            radius_mm=np.maximum(out[:, 4].astype(np.float64) * h, 0.1 * h),
            spacing_mm=h,
            source="multi",
            offset_mm=out[:, 1:4].astype(np.float64) * h,
        )


class SingleViewPredictor(_Warm):
    """The paper's single-view predictor. Takes what ``_Warm`` takes."""

    def input_names(self) -> list[str]:
        """Names of the graph's inputs; the axes only where the model is told the pose."""
        return ["picture", "axes"] if self.model.inputs["pose"] else ["picture"]

    def predict(
        self,
        views: Sequence[tuple[CArm, Image]],
        should_stop: Callable[[], bool] | None = None,
    ) -> list[ViewCenters]:
        """Predict centres in every view on its own.

        Parameters
        ----------
        views : sequence of (CArm, path_mm), (rows, columns) path length in mm, any size
        should_stop : as in ``CenterPredictor.predict``

        Returns
        -------
        ViewCenters per view, lifted along its true rays

        Raises
        ------
        ModelError, NumericalError, CancelledError
            As ``CenterPredictor.predict``.
        """
        pixels, alpha = int(self.model.inputs["pixels"]), int(self.model.inputs["alpha"])
        shape = (1, OUTPUTS, pixels // alpha, pixels // alpha)
        found = []
        with _watched(should_stop) as run_options:
            # One picture a call: memory does not grow with the number of views.
            for carm, path in views:
                picture = net_picture(carm, path, pixels)
                arrays = (picture.network_input(), picture.axes_input())
                feed = dict(zip(self.input_names(), arrays, strict=False))
                out = self._run(None, feed, run_options)[0]
                if out.shape != shape or not np.isfinite(out).all():
                    raise NumericalError(
                        f"model {self.model.name} returned values that are not finite"
                    )
                found.append(decode(out[0], picture, alpha))
        return found


#: either predictor, as the engine holds it
Predictor: TypeAlias = CenterPredictor | SingleViewPredictor


def open_predictor(model: ModelFile, *, threads: int = 2, session: Any = None) -> Predictor:
    """Return the predictor that a model file is made for."""
    kind = SingleViewPredictor if model.kind == "single" else CenterPredictor
    return kind(model, threads=threads, session=session)


def _open(model: ModelFile, threads: int) -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    # The arena makes inference a quarter faster. Memory patterns, planned anew for each number of
    # points, add two thirds to its peak and nothing to its speed.
    options.enable_cpu_mem_arena = True
    options.enable_mem_pattern = False
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return ort.InferenceSession(model.data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # noqa: BLE001 - ONNX Runtime's errors share no base class
        raise ModelError(f"model {model.name} does not load: {_first_line(error)}") from None


@contextlib.contextmanager
def _watched(should_stop: Callable[[], bool] | None) -> Iterator[Any]:
    """RunOptions whose run ends soon after ``should_stop`` says so; None without a question."""
    if should_stop is None:
        yield None
        return
    run_options, over = ort.RunOptions(), threading.Event()

    def watch() -> None:
        # Inference holds the calling thread for its whole length: only another one can ask.
        while not over.wait(WATCH_S):
            if should_stop():
                run_options.terminate = True
                return

    watcher = threading.Thread(target=watch, name="gcar-watch", daemon=True)
    watcher.start()
    try:
        yield run_options
    finally:
        over.set()
        watcher.join()


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0][:200] if str(error).strip() else type(error).__name__
