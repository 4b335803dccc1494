"""Run a table of cases: what is missing alone, rows as they come, a summary at the end."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gcar_deploy.batch.cases import BatchCase
from gcar_deploy.batch.pools import Pool, in_processes, on_dask
from gcar_deploy.batch.summary import write_summary
from gcar_deploy.batch.work import BatchEngine, BatchJob
from gcar_deploy.errors import UsageError

SCHEMA = "gcar-batch/1"
#: called with (cases done, cases in all, name of the last)
OnCase = Callable[[int, int, str], None]


def run_batch(
    cases: Sequence[BatchCase],
    out: Path,
    engine: BatchEngine,
    *,
    pool: Pool = Pool(),  # noqa: B008 - frozen
    force: bool = False,
    on_case: OnCase | None = None,
) -> list[dict[str, Any]]:
    """Run every case that has no row yet; write ``summary.csv`` and ``summary.html``.

    Parameters
    ----------
    cases : as ``read_cases`` returns them
    out : folder of an earlier run of the same, or a new one
    engine : which engine does them
    pool : where they run
    force : run cases again whose files or options have changed since, and failed ones
    on_case : told of each finished case

    Returns
    -------
    one row a case, in the order of the table

    Raises
    ------
    UsageError
        ``out`` holds something else, or a case changed and ``force`` was not given.
    """
    rows_folder = _own(out)
    rows: dict[str, dict[str, Any]] = {}
    missing: list[BatchJob] = []
    for case in cases:
        fingerprint = case.fingerprint(engine)
        row = _read_row(rows_folder / f"{case.name}.json")
        if row is not None and row["fingerprint"] != fingerprint and not force:
            raise UsageError(
                f"case {case.name!r}: its files or options changed since it was done in {out}; "
                "choose another folder or add --force"
            )
        failed = row is not None and row["status"] == "failed"
        if row is not None and row["fingerprint"] == fingerprint and not (force and failed):
            rows[case.name] = row
            continue
        # The workers of a cluster have working folders of their own.
        order = dataclasses.replace(case.order, out=out / case.name).relative_to(Path.cwd())
        marker = str((rows_folder / f"{case.name}.running").absolute())
        missing.append(
            BatchJob(
                case=case.name, order=order, engine=engine, fingerprint=fingerprint,
                marker=marker if pool.scheduler is None else None,
            )
        )  # fmt: skip
    if on_case is not None:
        on_case(len(rows), len(cases), "")
    for row in _done(missing, pool):
        _write_row(rows_folder / f"{row['case']}.json", row)
        rows[row["case"]] = row
        if on_case is not None:
            on_case(len(rows), len(cases), row["case"])
    ordered = [rows[case.name] for case in cases]
    write_summary(ordered, out)
    return ordered


def _own(out: Path) -> Path:
    """Make the folder, or recognise it as a batch's."""
    mark = out / "batch.json"
    if out.exists() and not mark.is_file() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"{out} exists and holds no batch; choose another folder")
    rows = out / "rows"
    try:
        rows.mkdir(parents=True, exist_ok=True)
        mark.write_text(json.dumps({"schema": SCHEMA}) + "\n", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{out} cannot be made ({error.strerror})") from None
    for left in rows.glob("*.running"):
        left.unlink(missing_ok=True)
    return rows


def _done(jobs: Sequence[BatchJob], pool: Pool) -> Iterator[dict[str, Any]]:
    if not jobs:
        return iter(())
    if pool.scheduler is not None:
        return on_dask(jobs, pool.scheduler)
    return in_processes(jobs, pool.processes)


def _read_row(path: Path) -> dict[str, Any] | None:
    try:
        row = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    known = isinstance(row, dict) and {"case", "status", "fingerprint"} <= row.keys()
    return row if known else None


def _write_row(path: Path, row: Mapping[str, Any]) -> None:
    partial = path.with_suffix(f".{os.getpid()}.partial")
    partial.write_text(json.dumps(row, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    partial.replace(path)
