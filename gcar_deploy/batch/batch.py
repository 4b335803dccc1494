"""Run a table of cases: what is missing alone, rows as they come, a summary at the end."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gcar_deploy.batch.cases import BatchCase
from gcar_deploy.batch.lock import only_one
from gcar_deploy.batch.pools import Pool, connected, in_processes, on_dask
from gcar_deploy.batch.summary import write_summary
from gcar_deploy.batch.work import BatchJob
from gcar_deploy.engine_choice import EngineChoice
from gcar_deploy.errors import UsageError
from gcar_deploy.files import is_there, whole_file

#: of the file that says that a folder is a batch's, and its name
SCHEMA, _MARK = "gcar-batch/1", "batch.json"
#: statuses of cases that have a result folder
_WITH_RESULT = ("ok", "degraded")
#: called with (cases done, cases in all, name of the last)
OnCase = Callable[[int, int, str], None]


def run_batch(
    cases: Sequence[BatchCase],
    out: Path,
    engine: EngineChoice,
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
        ``out`` holds something else, another batch is at work in it, a case changed and
        ``force`` was not given, or the scheduler does not answer; no new folder is left then.
    """
    new = _is_new(out)
    with contextlib.ExitStack() as held:
        client = None
        if new and pool.scheduler is not None:
            client = held.enter_context(connected(pool.scheduler))
        rows_folder = _made(out)
        held.enter_context(only_one("batch", out, rows_folder / "batch.lock"))
        for left in rows_folder.glob("*.running"):
            left.unlink(missing_ok=True)
        rows, missing = _known(cases, out, rows_folder, engine, pool, force=force)
        if on_case is not None:
            on_case(len(rows), len(cases), "")
        try:
            with contextlib.closing(_done(missing, pool, client)) as fresh:
                for row in fresh:
                    _write_row(rows_folder / f"{row['case']}.json", row)
                    rows[row["case"]] = row
                    if on_case is not None:
                        on_case(len(rows), len(cases), row["case"])
        finally:
            # After an interrupt too: what is done is told.
            ordered = [rows[case.name] for case in cases if case.name in rows]
            write_summary(ordered, out, of=len(cases))
    return ordered


def _known(
    cases: Sequence[BatchCase], out: Path, rows_folder: Path, engine: EngineChoice, pool: Pool, *,
    force: bool,
) -> tuple[dict[str, dict[str, Any]], list[BatchJob]]:  # fmt: skip
    """Return the rows that still hold, and the jobs that are left."""
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
        if row is not None and row["fingerprint"] == fingerprint:
            # A result that somebody took away is made again.
            kept = row["status"] not in _WITH_RESULT or (out / case.name / "result.json").is_file()
            if kept and not (force and row["status"] == "failed"):
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
    return rows, missing


def _is_new(out: Path) -> bool:
    """Whether there is no batch in a folder yet; refuse one that holds something else."""
    new = not (out / _MARK).is_file()
    if new and is_there(out) and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"{out} exists and holds no batch; choose another folder")
    return new


def _made(out: Path) -> Path:
    """Make the folder with its mark; return that of the rows."""
    rows = out / "rows"
    try:
        rows.mkdir(parents=True, exist_ok=True)
        (out / _MARK).write_text(json.dumps({"schema": SCHEMA}) + "\n", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{out} cannot be made ({error.strerror})") from None
    return rows


def _done(
    jobs: Sequence[BatchJob], pool: Pool, client: Any
) -> Generator[dict[str, Any], None, None]:
    """Yield rows as they come; a cluster without a ``client`` yet is asked where a row is left."""
    if jobs and client is not None:
        yield from on_dask(jobs, client)
    elif jobs and pool.scheduler is not None:
        with connected(pool.scheduler) as found:
            yield from on_dask(jobs, found)
    elif jobs:
        yield from in_processes(jobs, pool.processes)


def _read_row(path: Path) -> dict[str, Any] | None:
    try:
        row = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    known = isinstance(row, dict) and {"case", "status", "fingerprint"} <= row.keys()
    return row if known else None


def _write_row(path: Path, row: Mapping[str, Any]) -> None:
    with whole_file(path) as partial:
        partial.write_text(json.dumps(row, indent=1, allow_nan=False) + "\n", encoding="utf-8")
