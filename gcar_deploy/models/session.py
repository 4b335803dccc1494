"""A model that runs: the one place that imports ONNX Runtime."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from gcar_deploy.errors import CancelledError, ModelError, NumericalError, out_of_memory
from gcar_deploy.models.golden import check_golden
from gcar_deploy.models.spec import ModelFile
from gcar_deploy.types import Array


@contextlib.contextmanager
def _no_telemetry() -> Iterator[None]:
    """Ask ONNX Runtime not to report; a user's own setting wins, the environment stays as it was.

    It looks at this variable once, as it is loaded, and by then would have asked for a server's
    address and written to the home folder.
    """
    key = "ORT_DISABLE_TELEMETRY"
    told = key in os.environ
    os.environ.setdefault(key, "1")
    try:
        yield
    finally:
        if not told:
            os.environ.pop(key, None)


with _no_telemetry():
    import onnxruntime as ort

#: how often a running inference is asked whether it should end, seconds
WATCH_S = 0.02


class Session:
    """A warm session of one model; safe to share between threads.

    Parameters
    ----------
    model : ModelFile, as ``read_model`` returns it; it is opened, and its golden case, if any, is
        run, at once; a pinned one opens in the background
    inputs : names of the graph's inputs that the caller will give
    threads : int, within one inference; spinning is off, so idle threads cost nothing
    arena : bool, keep the memory of an inference for the next one: a quarter faster
    runtime : an existing ``onnxruntime.InferenceSession`` of the same model, optional

    Raises
    ------
    ModelError
        The model does not load, wants other inputs, or fails its golden case; of a pinned model
        that is told when it is first run.
    """

    def __init__(
        self,
        model: ModelFile,
        inputs: Sequence[str],
        *,
        threads: int = 2,
        arena: bool = True,
        runtime: Any = None,
    ) -> None:
        self.model = model
        self._given = runtime
        if runtime is None:
            # Opening holds no Python: the caller goes on, and waits at the first question.
            pool = ThreadPoolExecutor(1, "gcar-open")
            self._opened = pool.submit(_open, model, inputs, threads, arena)
            pool.shutdown(wait=False)
        if not model.pinned:
            _ = self._runtime
            self.check_golden()

    @property
    def _runtime(self) -> Any:
        return self._opened.result() if self._given is None else self._given

    def check_golden(self) -> float | None:
        """Run the model's golden case again; return the largest difference, None without one.

        Raises
        ------
        ModelError
            It answers differently from the day it was made.
        """
        if self.model.golden is None:
            return None
        return check_golden(self.model.name, self.model.golden, self._run)

    def answers(self, feed: Mapping[str, Array]) -> dict[str, Array]:
        """Run the graph on named inputs; return its outputs by name, as they are."""
        names = [node.name for node in self._runtime.get_outputs()]
        return dict(zip(names, self._run(names, feed), strict=True))

    def run(
        self,
        feed: Mapping[str, Array],
        shapes: Sequence[tuple[int, ...]],
        *,
        outputs: Sequence[str] | None = None,
        should_stop: Callable[[], bool] | None = None,
    ) -> list[Array]:
        """Run the graph and hold its answers to what they must be.

        Parameters
        ----------
        feed : inputs by name
        shapes : of the answers, in their order
        outputs : names of the answers; None for the graph's first ones
        should_stop : asked every ``WATCH_S`` from another thread; True ends a running inference

        Returns
        -------
        One array per shape; every value is finite.

        Raises
        ------
        ModelError, NumericalError
            The model cannot run on these inputs; it returned another shape, or values that are
            not finite.
        CancelledError
            ``should_stop`` said so.
        """
        with _watched(should_stop) as options:
            found = self._run(outputs, feed, options)[: len(shapes)]
        for answer, shape in zip(found, shapes, strict=True):
            if answer.shape != shape:
                raise NumericalError(
                    f"model {self.model.name} returned {answer.shape} values, not {shape}"
                )
            if not np.isfinite(answer).all():
                raise NumericalError(f"model {self.model.name} returned values that are not finite")
        return found

    def _run(
        self, outputs: Sequence[str] | None, feed: Mapping[str, Array], options: Any = None
    ) -> list[Array]:
        runtime = self._runtime
        try:
            found: list[Array] = runtime.run(outputs, dict(feed), options)
        except Exception as error:
            if getattr(options, "terminate", False):
                raise CancelledError("cancelled while the model ran") from None
            if out_of_memory(error):
                raise  # no fault of the model's
            raise ModelError(f"model {self.model.name} fails: {_first_line(error)}") from None
        return found


def _open(
    model: ModelFile, inputs: Sequence[str], threads: int, arena: bool
) -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    options.enable_cpu_mem_arena = arena
    # Memory patterns, planned anew for each number of points, add two thirds to the peak of the
    # centre predictor and nothing to its speed.
    options.enable_mem_pattern = False
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        opened = ort.InferenceSession(model.data, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        if out_of_memory(error):
            raise
        raise ModelError(f"model {model.name} does not load: {_first_line(error)}") from None
    found = [node.name for node in opened.get_inputs()]
    if sorted(found) != sorted(inputs) or not opened.get_outputs():
        raise ModelError(f"model {model.name} has other inputs than this version gives")
    return opened


@contextlib.contextmanager
def _watched(should_stop: Callable[[], bool] | None) -> Iterator[Any]:
    """RunOptions whose run ends soon after ``should_stop`` says so; None without a question.

    What the question raises is raised here, as it would be in the calling thread.
    """
    if should_stop is None:
        yield None
        return
    options, over = ort.RunOptions(), threading.Event()
    raised: list[BaseException] = []

    def watch() -> None:
        # Inference holds the calling thread for its whole length: only another one can ask.
        while not over.wait(WATCH_S):
            try:
                stop = should_stop()
            except BaseException as error:  # noqa: BLE001 - the caller's own; raised there
                raised.append(error)
                stop = True
            if stop:
                options.terminate = True
                return

    watcher = threading.Thread(target=watch, name="gcar-watch", daemon=True)
    watcher.start()
    try:
        yield options
    finally:
        over.set()
        watcher.join()
        if raised:
            raise raised[0] from None


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
