"""A case that takes its process along; apart from the tests, for its processes load this alone."""

from __future__ import annotations

import os
import signal

from gcar_deploy.batch import work


def suicidal(job):
    """Stands for a case that crashes a library: the process is gone without a word."""
    marker = job.marker
    open(marker, "w").close()
    if job.case == "killer":
        os.kill(os.getpid(), signal.SIGKILL)
    os.unlink(marker)
    return {**work.error_row(job.case, "ok", "", 0), "fingerprint": job.fingerprint}
