"""Seconds per stage: a cold ``gcar run`` as a whole process, and a warm ``Engine.reconstruct``.

Both reconstruct the demo's two 512 x 512 pictures. A cold process is a new interpreter each time;
the operating system has read the files before (the first run is not counted).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from gcar_deploy.data.demo_case import demo_case
from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError

#: what a new process does beside the stages of the reconstruction, in order
BEFORE, AFTER, WHOLE = ("imports", "model"), ("files",), "whole process"
#: what no process of these libraries can do without, and the highest resident memory, MB
LIBRARIES, PEAK = "import numpy, cv2, onnxruntime", "peak MB"
#: a process that takes longer is ended
_MOST_S = 600
_CHILD = """
import json, sys, time
t = [time.perf_counter()]
from gcar_deploy.engine import Engine
import gcar_deploy.output.bundle
t.append(time.perf_counter())
engine = Engine(threads=int(sys.argv[4]) or None)
t.append(time.perf_counter())
result = engine.reconstruct(sys.argv[1:3], sys.argv[3])
t.append(time.perf_counter())
result.save(sys.argv[5])
t.append(time.perf_counter())
own = {"imports": t[1] - t[0], "model": t[2] - t[1], "files": t[4] - t[3]}
try:
    told = open("/proc/self/status").read()
    own["peak MB"] = int(told.split("VmHWM:")[1].split()[0]) / 1024
except (OSError, IndexError):
    pass
json.dump({**own, **result.seconds}, sys.stdout)
"""


def stage_seconds(
    repeats: int, threads: int | None = None, on_run: Callable[[float], None] | None = None
) -> tuple[dict[str, float], dict[str, float]]:
    """Time cold and warm reconstructions of the demo.

    Parameters
    ----------
    repeats : runs of each that count; one more of each comes first and does not
    threads : as of ``Engine``
    on_run : told the share done

    Returns
    -------
    cold, warm : stage to median seconds; cold also ``imports``, ``model`` (read, check; the
        shipped one opens beside what follows), ``files`` (the result folder), ``whole process``
        (``gcar run``), beside it ``LIBRARIES``, and ``PEAK`` where the system tells it

    Raises
    ------
    GcarError
        A process failed.
    """
    report = on_run or (lambda share: None)
    case = demo_case()
    cold: list[dict[str, float]] = []
    warm: list[dict[str, float]] = []
    for k in range(repeats + 1):
        cold.append(_cold(threads))
        report(0.8 * (k + 1) / (repeats + 1))
    engine = Engine(threads=threads)
    for k in range(repeats + 1):
        warm.append(dict(engine.reconstruct(case.pictures, case.geometry).seconds))
        report(0.8 + 0.2 * (k + 1) / (repeats + 1))
    return medians(cold[1:]), medians(warm[1:])


def medians(runs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Median seconds of each stage that every run has."""
    return {name: float(np.median([run[name] for run in runs])) for name in runs[0]}


def table(cold: Mapping[str, float], warm: Mapping[str, float]) -> str:
    """Markdown of both, stages in their order."""
    stages = [name for name in warm if name != "total"]
    rows = ["| stage | cold s | warm s |", "|---|---|---|"]
    for name in (*BEFORE, *stages, "total", *AFTER, WHOLE, LIBRARIES):
        label = "pictures to tree" if name == "total" else name
        if name in cold:
            rows.append(f"| {label} | {_cell(cold, name)} | {_cell(warm, name)} |")
    if LIBRARIES in cold:
        rows.append(f"\nwhole process: {cold[WHOLE] / cold[LIBRARIES]:.1f} times these imports")
    if PEAK in cold:
        rows.append(f"\npeak resident memory: {cold[PEAK]:.0f} MB")
    return "\n".join(rows)


def _cell(seconds: Mapping[str, float], name: str) -> str:
    return f"{seconds[name]:.2f}" if name in seconds else "-"


def _cold(threads: int | None) -> dict[str, float]:
    """Run a process that tells its stages, ``gcar run`` and bare imports, timed from outside."""
    case = demo_case()
    inputs = [*(str(path) for path in case.pictures), str(case.geometry)]
    with tempfile.TemporaryDirectory(prefix="gcar-stages-") as folder:
        told = _process(["-c", _CHILD, *inputs, str(threads or 0), str(Path(folder) / "a")])
        run = ["-m", "gcar_deploy.cli.main", "run", *inputs[:2], "--geom", inputs[2], "--quiet",
               "--out", str(Path(folder) / "b")]  # fmt: skip
        started = time.perf_counter()
        _process([*run, *(["--threads", str(threads)] if threads else [])])
        ended = time.perf_counter()
        _process(["-c", LIBRARIES])
        bare = time.perf_counter() - ended
    seconds: dict[str, float] = json.loads(told)
    return {**seconds, WHOLE: ended - started, LIBRARIES: bare}


def _process(arguments: list[str]) -> str:
    # The first run, which does not count, leaves the bytecode that an installation comes with.
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    environment.setdefault("ORT_DISABLE_TELEMETRY", "1")  # ``LIBRARIES`` comes without gcar
    done = subprocess.run(  # noqa: S603 - our own interpreter and package
        [sys.executable, *arguments], capture_output=True, text=True, timeout=_MOST_S, check=False,
        env=environment,
    )  # fmt: skip
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise GcarError(f"a process that was to be timed failed: {last}")
    return done.stdout
