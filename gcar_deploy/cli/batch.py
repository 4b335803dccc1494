"""gcar batch CASES.CSV --out DIR."""

from __future__ import annotations

import dataclasses
import json
import os
import sys
from collections import Counter
from pathlib import Path

import click

from gcar_deploy.cli.common import (
    Talk,
    engine_options,
    gathered,
    say_result,
    talk_options,
)
from gcar_deploy.cli.paths import ANY_PATH
from gcar_deploy.cli.request import EXTRA_FILES, METHOD, order_options
from gcar_deploy.engine_choice import EngineChoice
from gcar_deploy.inputs.order import Order


@dataclasses.dataclass(frozen=True)
class Where:
    """Where the cases run."""

    jobs: int | None
    place: str
    scheduler: str | None


_WHERE = {
    "scheduler": click.option("--scheduler", metavar="ADDRESS", help="Of the Dask cluster."),
    "place": click.option(
        "--engine", "place", type=click.Choice(["processes", "dask"]), default="processes",
        show_default=True, help="Where the cases run.",
    ),
    "jobs": click.option(
        "--jobs", type=click.IntRange(1, 512), help="Processes; a core each by default."
    ),
}  # fmt: skip


@click.command("batch")
@click.argument("table", type=ANY_PATH, metavar="CASES.CSV")
@order_options(
    "out", *METHOD, "frames", "pixel_spacing_mm", "sod_mm", "allow_rescale", "segmenter", "pose",
    "strict", "force", *EXTRA_FILES,
)  # fmt: skip
@gathered("where", Where, _WHERE)
@engine_options
@talk_options()
def batch(table: Path, order: Order, where: Where, engine: EngineChoice, talk: Talk) -> None:
    """Reconstruct every case of a table (columns case, geom, view1, view2 ...).

    Further columns hold for one case and win over the options: mask1 ..., frame, landmarks
    (C1,R1:C2,R2, several apart by spaces), pixel_spacing_mm, sod_mm, segmenter, predictor, refiner,
    pose, deadline_s.

    Writes a result folder a case, summary.csv and summary.html; their least coverage is that of
    the view of which least is explained, weighed by thickness. A case that fails is a row
    with its reason and never stops the rest; the same command goes on where it was stopped, and
    runs changed and failed cases again with --force. Exit code 0 when the table is done, whatever
    became of its cases.

    \b
    Example:
      gcar batch cases.csv --out results
      gcar batch cases.csv --out results --engine dask --scheduler tcp://10.0.0.5:8786
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.errors import UsageError

    talk.set_up()
    if order.out is None:
        raise UsageError("--out is missing: name a folder for the results")
    if (where.place == "dask") != (where.scheduler is not None):
        raise UsageError("--engine dask and --scheduler ADDRESS go together")
    jobs = where.jobs or _cores()
    if where.place == "processes":
        if engine.threads is None and jobs > 1:
            engine = dataclasses.replace(engine, threads=1)
        # The processes inherit the limits.
        engine.limit_threads()
    from gcar_deploy.batch.batch import run_batch
    from gcar_deploy.batch.cases import read_cases
    from gcar_deploy.batch.pools import Pool

    cases = read_cases(table, dataclasses.replace(order, out=None, force=False))
    hidden = talk.quiet or not sys.stderr.isatty()
    with click.progressbar(length=len(cases), file=sys.stderr, hidden=hidden) as bar:
        rows = run_batch(
            cases,
            order.out,
            engine.absolute(),
            pool=Pool(jobs, where.scheduler),
            force=order.force,
            on_case=lambda done, *_: bar.update(done - bar.pos),
        )
    if talk.as_json:
        text = json.dumps({"out": str(order.out), "cases": rows}, allow_nan=False)
        say_result(text, order.out)
        return
    counts = Counter(row["status"] for row in rows)
    said = ", ".join(f"{number} {status}" for status, number in sorted(counts.items()))
    say_result(f"{order.out}\n{len(rows)} cases: {said}\n{order.out / 'summary.html'}", order.out)


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
