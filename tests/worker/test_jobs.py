"""The queue itself: order, what is forgotten, what one broken job does to the next."""

from __future__ import annotations

from pathlib import Path

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
