"""A process that only runs a predictor, and what memory it took: ``python -m`` this module.

``python -m gcar_export.methods.predictor_process MODEL FEED.npz`` prints one JSON object. It
imports nothing but the runtime's predictor, so its peak is that of a host that does nothing else.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import click
import numpy as np

from gcar_deploy.predict.center_predictor import open_predictor
from gcar_deploy.predict.kinds import read_predictor
from gcar_deploy.types import Array

#: inferences in the process; memory that is not given back shows after the first
RUNS = 3


def peak_mib(model: Path, feed: Mapping[str, Array]) -> float:
    """Peak resident memory, MiB, of a fresh process that runs ``feed`` through ``model``.

    Raises
    ------
    subprocess.CalledProcessError
        The process failed.
    """
    with tempfile.TemporaryDirectory(prefix="gcar-feed-") as folder:
        file = Path(folder) / "feed.npz"
        np.savez(file, **dict(feed))  # type: ignore[arg-type]
        done = subprocess.run(  # noqa: S603 - our own module, no shell
            [sys.executable, "-m", "gcar_export.methods.predictor_process", str(model), str(file)],
            capture_output=True, text=True, check=True, timeout=600,
        )  # fmt: skip
    return float(json.loads(done.stdout)["peak_mib"])


def main(model: Path, file: Path) -> dict[str, float]:
    """Run the feed a few times; return the peak of this process."""
    with np.load(file) as data:
        feed = dict(data)
    predictor = open_predictor(read_predictor(model), threads=2)
    for _ in range(RUNS):
        predictor.session.answers(feed)
    return {"peak_mib": _peak_mib()}


def _peak_mib() -> float:
    """Peak resident memory of this process, MiB."""
    status = Path("/proc/self/status")
    if status.is_file():
        # What getrusage says on Linux includes the parent's memory at the time of the fork.
        line = next(x for x in status.read_text().splitlines() if x.startswith("VmHWM:"))
        return int(line.split()[1]) / 2**10
    # Bytes on macOS.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


if __name__ == "__main__":
    click.echo(json.dumps(main(Path(sys.argv[1]), Path(sys.argv[2]))))
