"""A case that takes its process along; apart from the tests, for its processes load this alone."""

from __future__ import annotations

import os
import signal
import time

from gcar_deploy.batch import work


def suicidal(job):
    """Stands for a case that crashes a library: the process is gone without a word."""
    marker = job.marker
    open(marker, "w").close()
    if job.case == "killer":
        os.kill(os.getpid(), signal.SIGKILL)
    os.unlink(marker)
    return {**work.error_row(job.case, "ok", "", 0), "fingerprint": job.fingerprint}


def patient(job):
    """Stands for a case that asks whether it is still wanted; a stubborn one does not."""
    work._check_wanted()
    open(f"{job.marker}.begun", "w").close()
    if job.case != "a":
        open(job.marker, "w").close()
        for _ in range(6000):
            time.sleep(0.01)
            if job.fingerprint != "stubborn":
                work._check_wanted()
    return {**work.error_row(job.case, "ok", "", 0), "fingerprint": job.fingerprint}
