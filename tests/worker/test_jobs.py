"""The queue itself: order, what is forgotten, what one broken job does to the next."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import tempfile
import weakref
from pathlib import Path

import cv2
import numpy as np
import pytest

from gcar_deploy.errors import NumericalError
from gcar_deploy.inputs.order import Order
from gcar_deploy.worker.jobs import JobQueue, QueueFullError
from gcar_deploy.worker.order_folders import drop_scratch, new_scratch, sweep_scratch
from gcar_deploy.worker.orders import Received, suffix_of


def an_order(scratch=None, **fields):
    return Received(Order(views=(Path("a"), Path("b")), geometry={}, **fields), scratch)


@pytest.fixture
def queue():
    done = []

    def work(order, on_progress, cancel):
        done.append(order)
        if order.strict:
            raise ZeroDivisionError("secret detail")
        if order.force:
            raise NumericalError("not finite")
        return {"n": len(done)}, Path("folder")

    made = JobQueue(work, most_kept=3)
    yield made
    made.close()


def test_first_in_first_out_and_a_broken_job_harms_nobody(queue):
    jobs = [queue.submit(an_order(strict=k == 1, force=k == 2)) for k in range(4)]
    for job in jobs:
        assert job.finished.wait(30)
    assert [job.state for job in jobs] == ["done", "failed", "failed", "done"]
    assert [job.exit_code for job in jobs] == [None, 1, 8, None]
    assert "secret" not in (jobs[1].error or "")
    assert jobs[0].summary == {"n": 1} and jobs[3].summary == {"n": 4}


def test_what_a_broken_job_held_is_free_before_the_next():
    """Else a job that ran out of memory takes the next one with it: its traceback is in a cycle."""
    held = []

    class Large:
        pass

    def work(order, on_progress, cancel):
        assert not any(one() for one in held)
        large = Large()
        held.append(weakref.ref(large))
        try:
            raise MemoryError
        except MemoryError as error:
            kept = error  # noqa: F841 - frame and error hold each other
            raise

    queue = JobQueue(work)
    gc.disable()
    try:
        jobs = [queue.submit(an_order()) for _ in range(2)]
        assert all(job.finished.wait(30) for job in jobs)
    finally:
        gc.enable()
        queue.close()
    assert {job.error for job in jobs} == {"out of memory; use a smaller volume or pictures"}


def test_memory_that_ran_out_is_called_so_whichever_library_wants_it():
    def work(order, on_progress, cancel):
        cv2.resize(np.zeros((4, 4)), (1_000_000, 1_000_000))

    queue = JobQueue(work)
    job = queue.submit(an_order())
    assert job.finished.wait(30)
    queue.close()
    assert (job.error, job.exit_code) == (
        "out of memory; use a smaller volume or pictures",
        1,
    )


def test_who_cannot_be_told_of_a_job_does_not_end_the_worker():
    def work(order, on_progress, cancel):
        on_progress("vessels", 0.1)
        return {}, Path("folder")

    def gone(job):
        raise BrokenPipeError

    queue = JobQueue(work, on_change=gone)
    jobs = [queue.submit(an_order()) for _ in range(2)]
    assert all(job.finished.wait(30) for job in jobs)
    queue.close()
    assert [job.state for job in jobs] == ["done", "done"]


@pytest.mark.parametrize("kept", [False, True])
def test_copies_of_pictures_go_with_the_work(queue, tmp_path, kept):
    scratch = new_scratch()
    (scratch / "view1.png").write_bytes(b"1")
    out = scratch / "result" if kept else tmp_path / "result"
    if kept:
        out.mkdir()
    job = queue.submit(an_order(scratch=scratch, out=out))
    assert job.finished.wait(30) and job.state == "done"
    assert scratch.exists() is kept
    assert [path.name for path in scratch.glob("*")] == ["result"] * kept


def test_old_jobs_are_forgotten_with_their_files(queue):
    jobs = []
    for _ in range(5):
        jobs.append(queue.submit(an_order(scratch=new_scratch())))
        assert jobs[-1].finished.wait(30)
    # The last to finish may still be counted when its event is seen.
    queue.close()
    assert not any(job.received.scratch.exists() for job in jobs)
    with pytest.raises(QueueFullError):
        queue.submit(an_order())


@pytest.mark.skipif(os.name != "posix", reason="POSIX locks")
def test_pictures_of_a_killed_worker_are_removed_by_the_next(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    code = (
        "import time; from gcar_deploy.worker.order_folders import new_scratch\n"
        "folder = new_scratch(); (folder / 'view1.png').write_bytes(b'1')\n"
        "print(folder, flush=True); time.sleep(600)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    ) as worker:  # fmt: skip
        folder = Path(worker.stdout.readline().strip())
        own = new_scratch()
        try:
            assert sweep_scratch() == 0 and (folder / "view1.png").exists()
        finally:
            worker.kill()
    assert folder.parent == tmp_path and sweep_scratch() == 1
    assert list(tmp_path.iterdir()) == [own]
    drop_scratch(own)
    assert list(tmp_path.iterdir()) == []


def test_suffixes_of_uploaded_names():
    assert suffix_of("a/b.PNG") == ".png" and suffix_of("IM1") == ""
    assert suffix_of("x.p/../g") == "" and suffix_of("x.äö") == ""
