"""gcar bench: speed against error over the settings that trade one for the other."""

from __future__ import annotations

import csv
import dataclasses
import io
from pathlib import Path
from typing import Any

import click

from gcar_deploy.cli.common import ProgressBar, Talk, gathered, talk_options
from gcar_deploy.cli.paths import ANY_PATH
from gcar_deploy.engine_choice import EngineChoice

_FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)
COLUMNS = (
    "case", "predictor", "refiner", "iterations", "gaussians_cap", "pixels", "status",
    "gaussians", "p50_s", "p95_s", "pairs", "peak_mb", "dsc", "rmse_mm", "p95_mm", "over_bound",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Extent:
    """How much is measured."""

    data: Path | None
    quick: bool
    repeats: int
    threads: int | None


_EXTENT = {
    "threads": click.option("--threads", type=click.IntRange(1, 256), help="At most so many."),
    "repeats": click.option(
        "--repeats", type=click.IntRange(1, 100), default=5, show_default=True,
        help="Timings of each.",
    ),
    "quick": click.option(
        "--quick", is_flag=True, help="A coarse grid: about a tenth of the time."
    ),
    "data": click.option(
        "--data", type=_FOLDER, help="Label volumes to simulate views of, beside the demo."
    ),
}  # fmt: skip


@click.command("bench")
@click.option(
    "--out", "out_dir", default=None, type=ANY_PATH,
    help="New folder; needed without --stages.",
)  # fmt: skip
@click.option(
    "--stages", is_flag=True,
    help="Only print seconds per stage, of a new process and of a warm engine.",
)  # fmt: skip
@gathered("extent", Extent, _EXTENT)
@click.option("--force", is_flag=True, help="Replace bench.csv and bench.svg in the folder.")
@talk_options("quiet", "verbose")
def bench(out_dir: Path | None, stages: bool, extent: Extent, force: bool, talk: Talk) -> None:
    """Measure speed against error on the demo tree: bench.csv and bench.svg.

    The grid runs over iterations, Gaussians, resolution, refiner and predictor. Times are those
    of a warm reconstruction, and with itk-rtk installed also multiples of one projection pair.
    With --stages no file is written: a table of medians goes to stdout.

    \b
    Example:
      gcar bench --quick --out bench
      gcar bench --stages --repeats 5
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.errors import UsageError

    talk.set_up()
    EngineChoice(threads=extent.threads).limit_threads()
    if stages:
        click.echo(_stages(extent.repeats, extent.threads, talk.quiet))
        return
    if out_dir is None:
        raise UsageError("--out is missing: name a new folder, or ask for --stages")
    csv_file, svg_file = out_dir / "bench.csv", out_dir / "bench.svg"
    for path in (csv_file, svg_file):
        if path.exists() and not force:
            raise UsageError(f"{path} exists; --force replaces it")
    if out_dir.exists() and not out_dir.is_dir():
        raise UsageError(f"{out_dir} is not a folder")
    from gcar_deploy.bench import tradeoff as benchmark

    cases = [benchmark.demo(), *(benchmark.label_cases(extent.data) if extent.data else [])]
    grid = benchmark.cells(extent.quick)
    pair = benchmark.pair_seconds(cases[0])
    rows: list[benchmark.Row] = []
    with talk.bar() as bar:
        for row in benchmark.run(
            cases, grid, repeats=extent.repeats, threads=extent.threads, pair=pair
        ):
            rows.append(row)
            bar(f"{row.case} {row.cell.refiner}", len(rows) / (len(grid) * len(cases)))
    out_dir.mkdir(parents=True, exist_ok=True)
    csv_file.write_text(_csv(rows), encoding="utf-8")
    first = [row for row in rows if row.case == cases[0].name]
    svg_file.write_text(chart(first, cases[0].name), encoding="utf-8")
    click.echo("\n".join([str(csv_file), str(svg_file), *_lines(first, pair is not None)]))


def _stages(repeats: int, threads: int | None, quiet: bool) -> str:
    from gcar_deploy.bench.stages import stage_seconds, table

    with ProgressBar(quiet=quiet) as bar:
        cold, warm = stage_seconds(repeats, threads, lambda share: bar("stages", share))
    return table(cold, warm)


def chart(rows: list[Any], name: str) -> str:
    """Return the rows of one case as an SVG document."""
    from gcar_deploy.bench.chart import Point, tradeoff_svg
    from gcar_deploy.bench.tradeoff import front, knee

    def point(row: Any) -> Point:
        return Point(
            seconds=row.p50_s, error_mm=row.rmse_mm, text=_words(row),
            series=f"{row.cell.predictor} + {row.cell.refiner}",
        )  # fmt: skip

    usable = [row for row in rows if row.p50_s is not None and row.rmse_mm is not None]
    best = knee(usable)
    bound = None
    if best is not None and best.rmse_mm is not None and best.over_bound:
        bound = best.rmse_mm / best.over_bound
    return tradeoff_svg(
        [point(row) for row in usable],
        [point(row) for row in front(usable)],
        None if best is None else point(best),
        title=f"Speed against error: {name}",
        bound_mm=bound,
    )


def _words(row: Any) -> str:
    cap = "" if row.cell.gaussians is None else f", at most {row.cell.gaussians} Gaussians"
    return (
        f"{row.cell.predictor} + {row.cell.refiner}, {row.cell.iterations} iterations{cap}, "
        f"{row.cell.pixels} px: {row.p50_s:.3g} s, {row.rmse_mm:.3g} mm"
    )


def _csv(rows: list[Any]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for r in rows:
        c = r.cell
        figures = (r.p50_s, r.p95_s, r.pairs, r.peak_mb, r.dsc, r.rmse_mm, r.p95_mm, r.over_bound)
        writer.writerow(
            [r.case, c.predictor, c.refiner, c.iterations, c.gaussians, c.pixels, r.status, r.used]
            + [None if value is None else f"{value:.5g}" for value in figures]
        )
    return text.getvalue()


def _lines(rows: list[Any], paired: bool) -> list[str]:
    from gcar_deploy.bench.tradeoff import front, knee

    best = front(rows)
    if not best:
        return ["no setting gave a result"]
    out = ["Pareto front:", *(f"  {_words(row)}" for row in best)]
    at = knee(rows)
    if at is not None:
        unit = "" if at.pairs is None else f" = {at.pairs:.1f} itk-rtk pairs"
        out.append(f"more work buys nothing past: {_words(at)}{unit}")
    if not paired:
        out.append("itk-rtk is not installed: no pair to compare with (extra export)")
    return out
