"""gcar batch CASES.CSV --out DIR."""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from pathlib import Path

import click

from gcar_deploy.cli.common import engine_options, limit_threads, output_options, set_up_logging


@click.command("batch")
@click.argument("table", type=click.Path(path_type=Path), metavar="CASES.CSV")
@click.option(
    "--out", "out_dir", required=True, type=click.Path(path_type=Path), help="Folder of folders."
)
@click.option(
    "--jobs", type=click.IntRange(1, 512), default=None, help="Processes; a core each by default."
)
@click.option(
    "--engine",
    "where",
    type=click.Choice(["processes", "dask"]),
    default="processes",
    show_default=True,
    help="Where the cases run.",
)
@click.option("--scheduler", default=None, metavar="ADDRESS", help="Of the Dask cluster.")
@engine_options
@click.option("--force", is_flag=True, help="Run changed and failed cases again.")
@output_options
def batch(
    table: Path,
    out_dir: Path,
    jobs: int | None,
    where: str,
    scheduler: str | None,
    predictor: str,
    model: str | None,
    refiner: str,
    deadline: float | None,
    threads: int | None,
    force: bool,
    verbose: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Reconstruct every case of a table (columns case, geom, view1, view2 ...).

    Writes a result folder a case, summary.csv and summary.html. A case that fails is a row
    with its reason and never stops the rest; the same command goes on where it was stopped.
    Exit code 0 when the table is done, whatever became of its cases.

    \b
    Example:
      gcar batch cases.csv --out results
      gcar batch cases.csv --out results --engine dask --scheduler tcp://10.0.0.5:8786
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.errors import UsageError

    set_up_logging(verbose, quiet)
    if (where == "dask") != (scheduler is not None):
        raise UsageError("--engine dask and --scheduler ADDRESS go together")
    jobs = jobs or _cores()
    threads = threads or (1 if jobs > 1 and where == "processes" else None)
    if where == "processes":
        # The processes inherit the limits.
        limit_threads(threads)
    from gcar_deploy.batch.batch import run_batch
    from gcar_deploy.batch.cases import read_cases

    cases = read_cases(table)
    options = {
        "predictor": predictor,
        "refiner": refiner,
        "model": None if model is None else str(Path(model).absolute()),
        "threads": threads,
        "deadline_s": deadline,
    }
    hidden = quiet or not sys.stderr.isatty()
    with click.progressbar(length=len(cases), file=sys.stderr, hidden=hidden) as bar:
        rows = run_batch(
            cases,
            out_dir,
            options,
            processes=jobs,
            scheduler=scheduler,
            force=force,
            on_case=lambda done, *_: bar.update(done - bar.pos),
        )
    if as_json:
        click.echo(json.dumps({"out": str(out_dir), "cases": rows}, allow_nan=False))
        return
    counts = Counter(row["status"] for row in rows)
    said = ", ".join(f"{number} {status}" for status, number in sorted(counts.items()))
    click.echo(f"{out_dir}\n{len(rows)} cases: {said}\n{out_dir / 'summary.html'}")


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
