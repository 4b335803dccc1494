"""The queue itself: order, what is forgotten, what one broken job does to the next."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path

import cv2
import numpy as np
import pytest

from gcar_deploy.errors import NumericalError
from gcar_deploy.inputs.order import Order
from gcar_deploy.worker.jobs import JobQueue, QueueFullError
from gcar_deploy.worker.orders import Received, new_scratch, suffix_of


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


def test_suffixes_of_uploaded_names():
    assert suffix_of("a/b.PNG") == ".png" and suffix_of("IM1") == ""
    assert suffix_of("x.p/../g") == "" and suffix_of("x.äö") == ""
