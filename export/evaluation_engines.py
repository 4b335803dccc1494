"""Where the jobs of an evaluation run: here, in processes of this machine, on a Dask cluster.

Each engine yields (job, outcome) as they come, in any order; when the caller stops asking, or
an exception passes, what is waiting is cancelled.
"""

from __future__ import annotations

import concurrent.futures
import multiprocessing
from collections.abc import Iterator, Sequence
from typing import Any

from gcar_deploy.errors import UsageError
from gcar_export.evaluation_jobs import Done, Job, run_job
from gcar_export.method_settings import MethodSettings

ENGINES = ("processes", "dask")
#: seconds to wait for a Dask scheduler to answer.
CONNECT_S = 20
Outcome = tuple[Job, Done]


def run_here(jobs: Sequence[Job], settings: MethodSettings) -> Iterator[Outcome]:
    """One after the other in this process."""
    for job in jobs:
        yield job, run_job(job, settings)


def run_in_processes(
    jobs: Sequence[Job], settings: MethodSettings, processes: int
) -> Iterator[Outcome]:
    """In worker processes of this machine."""
    if processes == 1 or len(jobs) < 2:
        yield from run_here(jobs, settings)
        return
    # Spawned, not forked: the runtime and numba keep threads that do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(processes, mp_context=context) as pool:
        waiting = {pool.submit(run_job, job, settings): job for job in jobs}
        try:
            for future in concurrent.futures.as_completed(waiting):
                yield waiting[future], future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


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
