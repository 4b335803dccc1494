"""Jobs and their queue: one thread works, everyone else only looks and cancels."""

from __future__ import annotations

import collections
import dataclasses
import gc
import logging
import secrets
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gcar_deploy.errors import CancelledError, GcarError, RefusedError, out_of_memory
from gcar_deploy.inputs.order import Order
from gcar_deploy.worker.orders import Received

_log = logging.getLogger(__name__)
QUEUED, RUNNING, DONE = "queued", "running", "done"
REFUSED, FAILED, CANCELLED = "refused", "failed", "cancelled"
#: called with (order, on_progress, cancel); returns the summary and the result folder
Work = Callable[[Order, Callable[[str, float], None], Callable[[], bool]], tuple[Any, Path]]


class QueueFullError(GcarError):
    """As many jobs wait as may."""


@dataclasses.dataclass(eq=False)
class Job:
    """One reconstruction that was asked for.

    Attributes
    ----------
    id : str, unguessable
    received : the order and its private files
    state : ``queued``, ``running``, ``done``, ``refused``, ``failed`` or ``cancelled``
    stage, share : what is being done, and the share of the work done, 0 .. 1
    summary : content of ``result.json`` once done
    folder : the result folder once done
    error, exit_code : one line and the code that ``gcar run`` would give
    seconds : wall clock of the work
    """

    id: str
    received: Received
    state: str = QUEUED
    stage: str = ""
    share: float = 0.0
    summary: dict[str, Any] | None = None
    folder: Path | None = None
    error: str | None = None
    exit_code: int | None = None
    seconds: float | None = None
    finished: threading.Event = dataclasses.field(default_factory=threading.Event, repr=False)
    wish_to_stop: threading.Event = dataclasses.field(default_factory=threading.Event, repr=False)

    @property
    def order(self) -> Order:
        """What is to be done."""
        return self.received.order

    @property
    def open(self) -> bool:
        """Whether it still waits or runs."""
        return self.state in (QUEUED, RUNNING)


class JobQueue:
    """First in, first out, one at a time.

    Parameters
    ----------
    work : does one order; see ``Work``
    most_waiting : jobs that may wait
    most_kept : finished jobs that are remembered, the oldest forgotten first
    on_change : called with a job after each of its changes, from the working thread; what it
        raises is logged
    """

    def __init__(
        self,
        work: Work,
        *,
        most_waiting: int = 32,
        most_kept: int = 32,
        on_change: Callable[[Job], None] | None = None,
    ) -> None:
        self._work = work
        self._most_waiting, self._most_kept = most_waiting, most_kept
        self._on_change = on_change
        self._jobs: collections.OrderedDict[str, Job] = collections.OrderedDict()
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._loop, name="gcar-worker", daemon=True)
        self._thread.start()

    def submit(self, received: Received) -> Job:
        """Put an order at the end of the queue; its private files now belong to the job.

        Raises
        ------
        QueueFullError
            Too many wait already, or the queue is closing.
        """
        job = Job(id=secrets.token_urlsafe(12), received=received)
        with self._changed:
            if self._closing:
                raise QueueFullError("the worker is shutting down")
            if len(self._waiting()) >= self._most_waiting:
                raise QueueFullError(f"{self._most_waiting} jobs wait already; try again later")
            self._jobs[job.id] = job
            self._changed.notify_all()
        return job

    def get(self, job_id: str) -> Job | None:
        """Return a job that is still remembered."""
        with self._changed:
            return self._jobs.get(job_id)

    def ahead(self, job: Job) -> int:
        """How many jobs are done before this one, the running one included."""
        with self._changed:
            before = 0
            for other in self._jobs.values():
                if other is job:
                    return before if job.state == QUEUED else 0
                before += other.open
        return 0

    def counts(self) -> dict[str, int]:
        """Count the jobs in each state."""
        with self._changed:
            return dict(collections.Counter(job.state for job in self._jobs.values()))

    def cancel(self, job: Job) -> None:
        """End a job that waits at once, one that runs within a step."""
        with self._changed:
            job.wish_to_stop.set()
            if job.state != QUEUED:
                return
            job.error, job.exit_code = "cancelled by the caller", CancelledError.exit_code
            job.state = CANCELLED
        self._finish(job)

    def forget(self, job: Job) -> None:
        """Drop a finished job with its private files."""
        with self._changed:
            self._jobs.pop(job.id, None)
        job.received.clean()

    def close(self) -> None:
        """Cancel everything and wait for the working thread; called again, it does not wait."""
        with self._changed:
            again, self._closing = self._closing, True
            jobs = list(self._jobs.values())
            self._changed.notify_all()
        for job in jobs:
            self.cancel(job)
        if not again:
            self._thread.join()
        for job in jobs:
            self.forget(job)

    def _waiting(self) -> list[Job]:
        return [job for job in self._jobs.values() if job.state == QUEUED]

    def _loop(self) -> None:
        while True:
            with self._changed:
                while not (waiting := self._waiting()) and not self._closing:
                    self._changed.wait()
                if not waiting:
                    return
                job = waiting[0]
                job.state = RUNNING
            self._run(job)

    def _run(self, job: Job) -> None:
        started = time.perf_counter()

        def on_progress(stage: str, share: float) -> None:
            job.stage, job.share = stage, share
            self._tell(job)

        state = FAILED
        try:
            job.summary, job.folder = self._work(job.order, on_progress, job.wish_to_stop.is_set)
            state = DONE
        except CancelledError as error:
            job.error, job.exit_code = job.received.said(error), error.exit_code
            state = CANCELLED if job.wish_to_stop.is_set() else FAILED
        except GcarError as error:
            job.error, job.exit_code = job.received.said(error), error.exit_code
            state = REFUSED if isinstance(error, RefusedError) else FAILED
        except Exception as error:  # noqa: BLE001 - one broken job must not end the worker
            if out_of_memory(error):
                job.error = "out of memory; use a smaller volume or pictures"
            else:
                # Details may name files: they are told only to whoever asks for them.
                _log.error("internal error: %s", type(error).__name__)
                _log.debug("internal error", exc_info=True)
                job.error = f"internal error: {type(error).__name__}"
            job.exit_code = 1
        if state != DONE:
            # What a broken job held hangs in cycles of frames and errors; the next job needs it.
            gc.collect()
        job.seconds = time.perf_counter() - started
        # Last, since whoever sees the state may read the rest.
        job.state = state
        self._finish(job)

    def _finish(self, job: Job) -> None:
        if job.state == DONE:
            job.received.clean_inputs()
        else:
            job.received.clean()
        job.finished.set()
        self._tell(job)
        with self._changed:
            old = [other for other in self._jobs.values() if not other.open]
        for other in old[: max(0, len(old) - self._most_kept)]:
            self.forget(other)

    def _tell(self, job: Job) -> None:
        if self._on_change is None:
            return
        try:
            self._on_change(job)
        except Exception as error:  # noqa: BLE001 - who looks on must not end the only worker
            _log.error("a change of a job could not be told: %s", type(error).__name__)
            _log.debug("a change of a job could not be told", exc_info=True)
