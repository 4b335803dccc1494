"""Stopwatch of one reconstruction: seconds per stage, progress, deadline, cancel."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import time
from collections.abc import Callable, Iterator, Sequence

from gcar_deploy.errors import CancelledError

_log = logging.getLogger(__name__)

#: called with (stage, share of the whole work done, 0 .. 1)
OnProgress = Callable[[str, float], None]
#: what is kept of a deadline, as shares of the time that all before the refinement took: for what
#: follows its last step (sigma, tree, volume, quality), for its start, and for a tree without it
FINISH_SHARE, BEGIN_SHARE, UNREFINED_SHARE = 0.9, 0.5, 0.7


@dataclasses.dataclass(frozen=True)
class Budget:
    """Time for a refinement.

    Attributes
    ----------
    enough : whether it is worth beginning
    should_stop : asked before each step; True ends with the best so far
    """

    enough: bool = True
    should_stop: Callable[[], bool] | None = None


class Stopwatch:
    """Times the stages of one reconstruction and says when to stop.

    Parameters
    ----------
    shares : sequence of (stage, weight)
        Every stage in order with its usual share of the time, for the progress.
    on_progress : callable (stage, fraction), optional
    deadline_s : float, optional
        Seconds from the start after which ``should_stop`` is true.
    used_s : float
        Seconds that the caller has used up before.
    cancel : callable () -> bool, optional
    """

    def __init__(
        self,
        shares: Sequence[tuple[str, float]],
        *,
        on_progress: OnProgress | None = None,
        deadline_s: float | None = None,
        cancel: Callable[[], bool] | None = None,
        used_s: float = 0.0,
    ) -> None:
        self.seconds: dict[str, float] = {}
        self._started = time.perf_counter() - used_s
        self._deadline_s = deadline_s
        self._cancel = cancel
        self._on_progress = on_progress
        total = sum(weight for _, weight in shares) or 1.0
        done = 0.0
        self._span: dict[str, tuple[float, float]] = {}
        for stage, weight in shares:
            self._span[stage] = (done / total, (done + weight) / total)
            done += weight

    @property
    def elapsed_s(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self._started

    @property
    def late(self) -> bool:
        """Whether the deadline has passed."""
        return self._deadline_s is not None and self.elapsed_s > self._deadline_s

    @property
    def cancelled(self) -> bool:
        """Whether the caller wants out."""
        return self._cancel is not None and self._cancel()

    def should_stop(self) -> bool:
        """Whether an iteration should end with what it has."""
        return self.late or self.cancelled

    @property
    def question(self) -> Callable[[], bool] | None:
        """``should_stop``, or None where there is neither a deadline nor a way to cancel."""
        asked = self._deadline_s is not None or self._cancel is not None
        return self.should_stop if asked else None

    @property
    def left_s(self) -> float:
        """Seconds until the deadline, below 0 after it; infinite without one."""
        return float("inf") if self._deadline_s is None else self._deadline_s - self.elapsed_s

    def leaving(self, reserve_s: float) -> Callable[[], bool]:
        """Return a question for iterations: whether the deadline is ``reserve_s`` away or nearer.

        Asking raises CancelledError once the caller has cancelled.
        """

        def should_stop() -> bool:
            if self.cancelled:
                self.check()
            return self.left_s < reserve_s

        return should_stop

    def require(self, seconds: float) -> None:
        """Raise CancelledError if cancelled, or if less than ``seconds`` are left."""
        if self.cancelled or self.left_s < seconds:
            self.check()
            raise CancelledError(
                f"the deadline of {self._deadline_s:g} s leaves no time for a result"
            )

    def budget(self) -> Budget:
        """Share out what is left between the refinement and what follows it.

        Raises
        ------
        CancelledError
            Cancelled, or not even a tree without refinement can be finished in time.
        """
        before_s = self.elapsed_s
        self.require(UNREFINED_SHARE * before_s)
        enough = self.left_s >= (BEGIN_SHARE + FINISH_SHARE) * before_s
        return Budget(enough, self.leaving(FINISH_SHARE * before_s))

    def check(self) -> None:
        """Raise CancelledError if cancelled, or late; for stages without a usable half-result."""
        if self.cancelled:
            raise CancelledError("cancelled by the caller")
        if self.late:
            raise CancelledError(
                f"the deadline of {self._deadline_s:g} s passed before there was a result"
            )

    @contextlib.contextmanager
    def stage(self, name: str, *, keep_if_late: bool = False) -> Iterator[Callable[[float], None]]:
        """Time a stage; yields a function that reports its own progress, 0 .. 1.

        Raises
        ------
        CancelledError
            Before the stage: cancelled, or late unless ``keep_if_late``. Within it: what a
            running model raises becomes the sentence of ``check``.
        """
        if self.cancelled or not keep_if_late:
            self.check()
        low, high = self._span.get(name, (0.0, 0.0))

        def report(share: float) -> None:
            if self._on_progress is not None:
                self._on_progress(name, low + (high - low) * min(max(share, 0.0), 1.0))

        report(0.0)
        start = time.perf_counter()
        try:
            yield report
        except CancelledError:
            self.check()
            raise
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
        _log.debug("%s: %.3f s", name, self.seconds[name])
        report(1.0)
