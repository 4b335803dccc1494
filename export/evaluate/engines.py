"""Where the jobs of an evaluation run: here, in processes of this machine, on a Dask cluster.

Each engine yields (job, outcome) as they come, in any order; when the caller stops asking, or
an exception passes, what is waiting is cancelled.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import multiprocessing
import os
import signal
from collections.abc import Iterator, Sequence
from typing import Any

from gcar_deploy.errors import UsageError
from gcar_export.evaluate.jobs import Done, Job, run_job
from gcar_export.methods.settings import MethodSettings

ENGINES = ("processes", "dask")
#: seconds to wait for a Dask scheduler to answer.
CONNECT_S = 20
#: read by numerical libraries when they are loaded.
THREAD_VARIABLES = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS",
    "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS",
)  # fmt: skip
Outcome = tuple[Job, Done]


def run_here(jobs: Sequence[Job], settings: MethodSettings) -> Iterator[Outcome]:
    """One after the other in this process."""
    for job in jobs:
        yield job, run_job(job, settings)


def run_in_processes(
    jobs: Sequence[Job], settings: MethodSettings, processes: int
) -> Iterator[Outcome]:
    """In worker processes of this machine, which share its cores among them.

    An interrupt ends the workers at once: the rows they were at are made again next time.
    """
    if processes == 1 or len(jobs) < 2:
        yield from run_here(jobs, settings)
        return
    others = set(multiprocessing.active_children())
    # Spawned, not forked: the runtime and numba keep threads that do not survive a fork.
    context = multiprocessing.get_context("spawn")
    threads = max(1, (os.cpu_count() or 1) // processes)
    with (
        _few_threads(threads),
        concurrent.futures.ProcessPoolExecutor(
            processes, mp_context=context, initializer=_leave_interrupts_to_the_parent
        ) as pool,
    ):
        waiting = {pool.submit(run_job, job, settings): job for job in jobs}
        try:
            for future in concurrent.futures.as_completed(waiting):
                yield waiting[future], future.result()
        except BaseException:
            for future in waiting:
                future.cancel()
            for worker in set(multiprocessing.active_children()) - others:
                worker.terminate()
            raise  # leaving the pool waits for the ends of its workers


def _leave_interrupts_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextlib.contextmanager
def _few_threads(threads: int) -> Iterator[None]:
    """Start child processes with so many threads, unless the user said otherwise."""
    missing = [name for name in THREAD_VARIABLES if name not in os.environ]
    os.environ.update(dict.fromkeys(missing, str(threads)))
    try:
        yield
    finally:
        for name in missing:
            os.environ.pop(name, None)


def run_on_dask(
    jobs: Sequence[Job], settings: MethodSettings, scheduler: str | None
) -> Iterator[Outcome]:
    """On an existing Dask cluster, whose workers have gcar and see the data under one path.

    Raises
    ------
    UsageError
        Dask is not installed, no scheduler is given, or none answers there.
    """
    client, as_completed = _connect(scheduler)
    with client:
        waiting = {client.submit(run_job, job, settings, pure=False): job for job in jobs}
        try:
            for future in as_completed(list(waiting)):
                yield waiting[future], future.result()
        finally:
            client.cancel(list(waiting))


def _connect(scheduler: str | None) -> tuple[Any, Any]:
    if not scheduler:
        raise UsageError("engine dask needs --scheduler tcp://HOST:PORT")
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise UsageError(
            "engine dask needs the package distributed: pip install 'gcar[dask]'"
        ) from None
    try:
        return Client(scheduler, timeout=CONNECT_S), as_completed
    except (OSError, TimeoutError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UsageError(f"scheduler {scheduler!r} does not answer: {reason}") from None
