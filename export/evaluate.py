"""Evaluate methods over label volumes: simulate, reconstruct, measure, tabulate.

One job is one case, one number of views and one method; its row is written as soon as it
is done, so an interrupted evaluation goes on where it stopped.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import json
import logging
import multiprocessing
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gcar_deploy.errors import UsageError
from gcar_deploy.metrics import Measure, projection_measures, volume_measures
from gcar_export import evaluation_tables as tables
from gcar_export.labels import LabelVolume, read_label
from gcar_export.methods import METHODS, Solved, solve
from gcar_export.protocols import PROTOCOLS, Case, make_case
from gcar_export.raycast import as_label, raycast

LOGGER = logging.getLogger(__name__)
#: where label volumes are looked for below the data folder, in this order.
LABEL_PATTERNS = (
    "imagecas/*.label.nii.gz", "asoca/*.npz", "asoca/*.nrrd",
    "*.label.nii.gz", "*.nii.gz", "*.nrrd", "*.mha",
)  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """What to evaluate.

    Attributes
    ----------
    data : folder with label volumes (``imagecas/``, ``asoca/``, or the files themselves)
    out : folder for rows and tables; may hold an interrupted evaluation
    protocol : one of ``PROTOCOLS``
    methods : names from ``METHODS``
    views : numbers of views
    jobs : processes
    cases : only cases with these names; all if empty
    reference : method the others are tested against; the first of ``methods`` if None
    """

    data: Path
    out: Path
    protocol: str
    methods: tuple[str, ...]
    views: tuple[int, ...] = (2,)
    jobs: int = 1
    cases: tuple[str, ...] = ()
    reference: str | None = None

    def __post_init__(self) -> None:
        if self.protocol not in PROTOCOLS:
            raise UsageError(f"protocol {self.protocol!r} is none of {', '.join(PROTOCOLS)}")
        unknown = [m for m in self.methods if m not in METHODS]
        if unknown or not self.methods:
            raise UsageError(f"unknown method {unknown}; there are {', '.join(METHODS)}")
        if not self.views or any(not 2 <= n <= 16 for n in self.views):
            raise UsageError(f"views = {self.views!r} must be numbers from 2 to 16")
        if self.jobs < 1:
            raise UsageError(f"jobs = {self.jobs} must be at least 1")
        if self.reference is not None and self.reference not in self.methods:
            raise UsageError(f"reference {self.reference!r} is not among the methods")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Job:
    """One row to be made; ``row_path`` is where it goes."""

    label: Path
    protocol: str
    method: str
    views: int
    row_path: Path


def find_labels(data: Path) -> list[Path]:
    """Label volumes below a folder: ImageCAS, ASOCA, or any mask lying in it.

    Raises
    ------
    UsageError
        If there are none.
    """
    found: dict[Path, None] = {}
    for pattern in LABEL_PATTERNS:
        for path in sorted(data.glob(pattern)):
            found.setdefault(path)
    if not found:
        raise UsageError(f"no label volume in {data} ({', '.join(LABEL_PATTERNS)})")
    return list(found)


def evaluate(
    options: EvaluateOptions, on_progress: Callable[[int, int, str], None] | None = None
) -> list[dict[str, Any]]:
    """Run what is missing, write the tables, and return all rows.

    Parameters
    ----------
    options : EvaluateOptions
    on_progress : called with (done, total, text) after each row
    """
    labels = [p for p in find_labels(options.data) if _wanted(p, options.cases)]
    if not labels:
        raise UsageError(f"none of the cases {', '.join(options.cases)} is in {options.data}")
    rows_folder = options.out / "rows"
    rows_folder.mkdir(parents=True, exist_ok=True)
    jobs = [
        Job(
            label=label,
            protocol=options.protocol,
            method=method,
            views=views,
            row_path=rows_folder / f"{options.protocol}-{case_name(label)}-{views}-{method}.json",
        )
        for label in labels
        for views in options.views
        for method in options.methods
    ]
    missing = [job for job in jobs if not job.row_path.exists()]
    done = len(jobs) - len(missing)
    for job in _run(missing, options.jobs):
        done += 1
        if on_progress is not None:
            on_progress(done, len(jobs), job.row_path.stem)
    rows = [json.loads(job.row_path.read_text()) for job in jobs]
    write_tables(rows, options.out, options.reference or options.methods[0])
    return rows


def write_tables(rows: Sequence[dict[str, Any]], out: Path, reference: str) -> None:
    """Write ``cases.csv``, ``summary.json``, ``wilcoxon.json`` and ``tables.md``."""
    (out / "cases.csv").write_text(tables.case_rows_csv(rows))
    summary = json.dumps(tables.summarise(rows), indent=1, allow_nan=False)
    (out / "summary.json").write_text(summary)
    tests = json.dumps(tables.paired_tests(rows, reference), indent=1, allow_nan=False)
    (out / "wilcoxon.json").write_text(tests)
    (out / "tables.md").write_text(tables.markdown(rows, reference))


def case_name(label: Path) -> str:
    """Name of the case a label file holds, as ``read_label`` gives it."""
    stem = label.name.split(".")[0]
    return f"asoca_{stem}" if label.suffix == ".npz" else stem


def measure(case: Case, solved: Solved) -> dict[str, Measure]:
    """All measures of one solved case, by the names of ``evaluation_tables.MEASURES``.

    New projections are cast from the returned volume, clipped to 0 .. 1, and averaged over
    the case's new views (those on which the measure is defined).
    """
    found = volume_measures(case.truth, solved.volume, case.grid.spacing_mm)
    per_view = []
    for carm, truth_mm in zip(case.new_views, case.new_projections(), strict=True):
        predicted = None
        if solved.volume is not None and np.isfinite(solved.volume).all():
            volume = as_label(np.clip(solved.volume, 0, 1), case.grid)
            predicted = raycast(volume, carm)
        per_view.append(projection_measures(truth_mm, predicted))
    for name in per_view[0]:
        found[f"new_{name}"] = _mean([view[name] for view in per_view])
    return found


def run_job(job: Job) -> dict[str, Any]:
    """Make, write and return one row."""
    case = _case(job.label, job.protocol, job.views)
    solved = solve(case, job.method)
    found = measure(case, solved)
    row = {
        "protocol": job.protocol,
        "case": case.name,
        "method": job.method,
        "views": job.views,
        "status": solved.status,
        "sentence": solved.sentence,
        "measures": {name: m.value for name, m in found.items()},
        "reasons": {name: m.reason for name, m in found.items() if m.reason is not None},
        "gaussians": solved.gaussians,
        "seconds": float(solved.seconds["total"]),
        "stages": {stage: float(s) for stage, s in solved.seconds.items()},
    }
    text = json.dumps(row, indent=1, allow_nan=False)
    partial = job.row_path.with_suffix(f".{os.getpid()}.partial")
    partial.write_text(text)
    partial.replace(job.row_path)
    return row


@functools.lru_cache(maxsize=1)
def _label(path: Path) -> LabelVolume:
    return read_label(path)


@functools.lru_cache(maxsize=1)
def _case(path: Path, protocol: str, views: int) -> Case:
    return make_case(_label(path), protocol, views)


def _run(jobs: Sequence[Job], processes: int) -> Any:
    """Yield each job when its row is written."""
    if processes == 1 or len(jobs) < 2:
        for job in jobs:
            run_job(job)
            yield job
        return
    # Spawned, not forked: the runtime and numba keep threads that do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(processes, mp_context=context) as pool:
        waiting = {pool.submit(run_job, job): job for job in jobs}
        try:
            for future in concurrent.futures.as_completed(waiting):
                future.result()
                yield waiting[future]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _wanted(label: Path, names: Sequence[str]) -> bool:
    return not names or case_name(label) in names or label.name.split(".")[0] in names


def _mean(measures: Sequence[Measure]) -> Measure:
    values = [m.value for m in measures if m.value is not None]
    if values:
        return Measure(float(np.mean(values)))
    return Measure(None, measures[0].reason)
