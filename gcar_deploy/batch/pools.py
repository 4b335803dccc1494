"""Where the cases run: processes of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import multiprocessing
import signal
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from gcar_deploy.batch.work import BatchJob, error_row, prepare_process, run_case
from gcar_deploy.errors import UsageError

#: seconds to reach a scheduler
CONNECT_S = 30


@dataclasses.dataclass(frozen=True)
class Pool:
    """Processes of this machine, or the address of a Dask scheduler instead."""

    processes: int = 1
    scheduler: str | None = None


def in_processes(jobs: Sequence[BatchJob], processes: int) -> Iterator[dict[str, Any]]:
    """Yield each case's row as it is done.

    A process that dies (out of memory, a crash in a library) takes its pool along: the cases
    that were running are then run alone, one by one, and the one that kills its process again
    gets a row that says so. An interrupt ends what runs; rows that are done come before it goes on.
    """
    waiting = list(jobs)
    while waiting:
        finished: set[str] = set()
        try:
            with contextlib.closing(_pool(waiting, processes)) as rows:
                for row in rows:
                    finished.add(row["case"])
                    yield row
        except BrokenProcessPool:
            suspects = [
                job
                for job in waiting
                if job.case not in finished and job.marker and Path(job.marker).exists()
            ]
            # Killed before any case began: the machine, not a case, is at fault.
            for job in suspects or [job for job in waiting if job.case not in finished][:1]:
                finished.add(job.case)
                yield _alone(job)
        waiting = [job for job in waiting if job.case not in finished]


def _pool(jobs: Sequence[BatchJob], processes: int) -> Generator[dict[str, Any], None, None]:
    # Spawned, not forked: numerical libraries keep threads that do not survive a fork.
    spawn = multiprocessing.get_context("spawn")
    # Without a lock: a process that dies may hold one.
    end = spawn.RawValue("b", 0)
    others = set(multiprocessing.active_children())
    pool = concurrent.futures.ProcessPoolExecutor(
        min(processes, len(jobs)),
        mp_context=spawn,
        initializer=prepare_process,
        initargs=(jobs[0].engine.threads, end),
    )
    waiting: set[concurrent.futures.Future[dict[str, Any]]] = set()
    try:
        with _without_interrupts():
            waiting.update(pool.submit(run_case, job) for job in jobs)
        for future in concurrent.futures.as_completed(list(waiting)):
            row = future.result()
            waiting.remove(future)
            yield row
    except BaseException as error:
        end.value = 1
        try:
            pool.shutdown(cancel_futures=True)
        except BaseException:
            # Asked again: without manners.
            for process in set(multiprocessing.active_children()) - others:
                process.kill()
            raise
        if not isinstance(error, GeneratorExit):
            for future in waiting:
                if not future.cancelled() and future.exception() is None:
                    yield future.result()
        raise
    pool.shutdown()


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Start processes that an interrupt from the terminal does not reach; it comes afterwards."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _alone(job: BatchJob) -> dict[str, Any]:
    try:
        with contextlib.closing(_pool([job], 1)) as rows:
            return next(rows)
    except BrokenProcessPool:
        if job.marker is not None:
            Path(job.marker).unlink(missing_ok=True)
        row = error_row(job.case, "failed", "its process died; out of memory?", 1)
        return {**row, "fingerprint": job.fingerprint}


@contextlib.contextmanager
def connected(scheduler: str) -> Iterator[Any]:
    """Give the client of a Dask cluster.

    Raises
    ------
    UsageError
        The library is missing, or the scheduler does not answer.
    """
    try:
        from distributed import Client
    except ModuleNotFoundError:
        raise UsageError("distributed is not installed: pip install 'gcar[dask]'") from None
    try:
        client = Client(scheduler, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise UsageError(f"scheduler {scheduler} does not answer ({error})") from None
    with client:
        yield client


def on_dask(jobs: Sequence[BatchJob], client: Any) -> Iterator[dict[str, Any]]:
    """Yield each case's row as it is done by a cluster that sees the same files."""
    from distributed import as_completed

    # Not pure: the folder that a case writes is the point of it.
    case_of = {
        client.submit(run_case, job, pure=False, key=f"gcar-{job.case}-{job.fingerprint[:16]}"): job
        for job in jobs
    }
    for future in as_completed(list(case_of)):
        job = case_of[future]
        failure = future.exception()
        if failure is None:
            yield future.result()
        else:
            text = f"its worker failed: {type(failure).__name__}"
            yield {**error_row(job.case, "failed", text, 1), "fingerprint": job.fingerprint}
