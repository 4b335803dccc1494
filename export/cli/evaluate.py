"""``gcar-export evaluate`` and ``converge``: parse, call one function, print."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from gcar_deploy.errors import UsageError
from gcar_export.cli.options import COUNT, FILE, FOLDER, OUT_FOLDER, counted

if TYPE_CHECKING:
    from gcar_export.evaluate.evaluate import EvaluateOptions

_SET_UPS = ["paper", "clinical", "moved", "raw"]
_PROTOCOL = click.option(
    "--protocol", type=click.Choice(_SET_UPS), default="paper", show_default=True
)
_PAPER_STEPS = click.option(
    "--paper-steps", type=COUNT, help="Steps of the paper's refinement in all rows that use it."
)


class _Progress:
    """A bar on a terminal, a line per row elsewhere; on stderr, nothing with ``quiet``."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet, self._at = quiet, 0
        self._bar: Any = None

    def __call__(self, done: int, total: int, text: str) -> None:
        if self._quiet:
            return
        if not sys.stderr.isatty():
            click.echo(f"[{done}/{total}] {text}", err=True)
            return
        if self._bar is None:
            self._bar = click.progressbar(
                length=total, file=sys.stderr, show_pos=True, item_show_func=lambda item: item
            )
        self._bar.update(done - self._at, text)
        self._at = done

    def close(self) -> None:
        """Leave the bar as it is, on a line of its own."""
        if self._bar is not None:
            self._bar.render_finish()


def _list_methods(ctx: click.Context, _: click.Parameter, methods: str) -> str:
    """List the methods if that is asked for; nothing else has to be given then."""
    if methods == "help":
        from gcar_export.methods.settings import DESCRIPTIONS

        for name, text in DESCRIPTIONS.items():
            click.echo(f"{name:20} {text}")
        ctx.exit()
    return methods


@click.command()
@click.option("--data", type=FOLDER, help="Folder with label volumes; not for thin.")
@click.option(
    "--protocol",
    type=click.Choice([*_SET_UPS, "common", "thin"]),
    default="paper",
    show_default=True,
    help="common: masks of one artery, as PPCAR-Net and its peers are compared; thin: generated "
    "trees with thin branches.",
)
@click.option(
    "--methods",
    default="ours,multi,hull+tube,hull,visual_hull,fdk,sart,nerp",
    show_default=True,
    is_eager=True,
    callback=_list_methods,
    help="Comma-separated; the first is the one the others are tested against. 'help' lists all.",
)
@click.option("--views", default="2", show_default=True, help="Comma-separated, 2 .. 16 each.")
@click.option("--out", type=OUT_FOLDER, required=True, help="Rows, tables, pictures, report.")
@counted("--jobs", 1, "Processes on this machine.")
@click.option("--cases", default="", help="Only these cases, comma-separated.")
@_PAPER_STEPS
@click.option(
    "--model", type=FILE, help="Predictor of your own, an ONNX file, for the rows that ask one."
)
@click.option("--segmenter-model", type=FILE, help="Likewise, of raw pictures (protocol raw).")
@click.option(
    "--engine",
    type=click.Choice(["processes", "dask"]),
    default="processes",
    show_default=True,
    help="Where rows are made; dask needs --scheduler.",
)
@click.option("--scheduler", help="Address of a Dask scheduler, tcp://HOST:PORT.")
@click.option(
    "--changed",
    type=click.Choice(["redo", "keep", "refuse"]),
    default="redo",
    show_default=True,
    help="Rows in --out that were made with other settings or label files.",
)
@click.option("--redo", default="", help="Make the rows of these methods anew in any case.")
@click.option(
    "--draw-only",
    is_flag=True,
    help="Tables and pictures anew from --out/cases.csv, of what is named.",
)
@click.option("--quiet", is_flag=True, help="No progress on stderr.")
def evaluate(
    data: Path | None,
    protocol: str,
    methods: str,
    views: str,
    out: Path,
    jobs: int,
    cases: str,
    paper_steps: int | None,
    model: Path | None,
    segmenter_model: Path | None,
    engine: str,
    scheduler: str | None,
    changed: str,
    redo: str,
    draw_only: bool,
    quiet: bool,
) -> None:
    """Run methods over label volumes, print the table, draw the pictures, write a report.

    Goes on where an earlier run with the same --out stopped.

    Example: gcar-export evaluate --data data --protocol clinical --methods ours,hull
    --views 2,4 --out results
    """
    from gcar_export.evaluate import evaluate as evaluation
    from gcar_export.evaluate import peers
    from gcar_export.evaluate import tables as evaluation_tables
    from gcar_export.evaluate.report import draw
    from gcar_export.methods.own_models import OwnModels
    from gcar_export.methods.settings import MethodSettings

    options = evaluation.EvaluateOptions(
        data=data,
        out=out,
        protocol=protocol,
        methods=words(methods),
        views=numbers(views),
        jobs=jobs,
        cases=words(cases),
        engine=engine,
        scheduler=scheduler,
        changed=changed,
        redo=words(redo),
        settings=MethodSettings(
            paper_steps=paper_steps,
            own=OwnModels(predictor=_absolute(model), segmenter=_absolute(segmenter_model)),
        ),
    )
    reference = options.methods[0]
    if draw_only:
        rows = _asked(evaluation_tables.read_case_rows(out / "cases.csv"), options)
        methods_there = [row["method"] for row in rows]
        reference = reference if reference in methods_there else methods_there[0]
        evaluation.write_summaries(rows, out, reference)
    else:
        progress = _Progress(quiet=quiet)
        try:
            rows = evaluation.evaluate(options, progress)
        except KeyboardInterrupt:
            click.echo(f"\nfinished rows are in {out}; the same command goes on", err=True)
            raise
        finally:
            progress.close()
    click.echo(evaluation_tables.markdown(rows, reference))
    click.echo(peers.beside_peers(rows))
    click.echo(draw(rows, out, reference))
    left_out = "" if draw_only else evaluation.beside(options, rows)
    if left_out:
        click.echo(left_out, err=True)
    lost = evaluation.without_case(rows)
    if lost:
        count = len({row["case"] for row in rows})
        click.echo(f"{len(lost)} of {count} cases could not be made:", err=True)
    for reason in lost.values():
        click.echo(f"  {reason}", err=True)


@click.command()
@click.option("--data", type=FOLDER, required=True, help="Folder with label volumes.")
@_PROTOCOL
@click.option("--methods", default="nerp,3dgr-fbp", show_default=True, help="Comma-separated.")
@click.option("--steps", default="25,50,100,200,400", show_default=True, help="Budgets.")
@click.option("--views", type=click.IntRange(2, 16), default=2, show_default=True)
@click.option("--cases", default="", help="Only these cases, comma-separated.")
@click.option("--out", type=OUT_FOLDER, required=True, help="Rows, converge.csv, converge.png.")
@counted("--jobs", 1, "Processes on this machine.")
@click.option("--quiet", is_flag=True, help="No progress on stderr.")
def converge(
    data: Path,
    protocol: str,
    methods: str,
    steps: str,
    views: int,
    cases: str,
    out: Path,
    jobs: int,
    quiet: bool,
) -> None:
    """Show how accuracy depends on the steps of the iterative methods.

    Goes on where an earlier run with the same --out stopped.

    Example: gcar-export converge --data data --cases 0001,0595 --out curves
    """
    from gcar_export.evaluate.evaluate import EvaluateOptions
    from gcar_export.studies import converge as convergence

    options = EvaluateOptions(
        data=data,
        out=out,
        protocol=protocol,
        methods=words(methods),
        views=(views,),
        cases=words(cases),
        jobs=jobs,
    )
    progress = _Progress(quiet=quiet)
    try:
        rows = convergence.converge(options, numbers(steps), progress)
    finally:
        progress.close()
    click.echo(convergence.table(rows))
    click.echo(out / "converge.png")


@click.command("paper-page")
@click.option("--data", type=FOLDER, required=True, help="Folder with imagecas/ and asoca/.")
@click.option("--out", type=OUT_FOLDER, required=True, help="Rows, paper.md, paper-views.png.")
@click.option("--paper-steps", type=COUNT, help="Most iterations; the printed 8,000 without.")
@click.option("--cases", default="", help="Only these cases, comma-separated.")
@counted("--jobs", 1, "Processes on this machine.")
@click.option("--draw-only", is_flag=True, help="Run nothing; draw what is there.")
@click.option("--quiet", is_flag=True, help="No progress on stderr.")
def paper_page(
    data: Path, out: Path, paper_steps: int | None, cases: str, jobs: int, draw_only: bool,
    quiet: bool,
) -> None:  # fmt: skip
    """Print the paper's tables and draw its figures, in its layout, beside its printed values.

    Takes hours on two cores. Goes on where an earlier run with the same --out stopped.

    Example: gcar-export paper-page --data data --out paper --paper-steps 600
    """
    from gcar_export.studies import paper_page as study

    if not draw_only:
        progress = _Progress(quiet=quiet)
        try:
            study.run(
                data, out, paper_steps=paper_steps, cases=words(cases), jobs=jobs,
                progress=progress,
            )  # fmt: skip
        finally:
            progress.close()
    rows = study.read_rows(out)
    text = study.page(rows)
    (out / "paper.md").write_text(text + "\n", encoding="utf-8")
    click.echo(text)
    click.echo(study.draw(rows, out))


def _asked(rows: list[dict[str, Any]], options: EvaluateOptions) -> list[dict[str, Any]]:
    """Return the rows that options on the command line name; all where none does.

    Raises
    ------
    UsageError
        There are none.
    """
    ctx = click.get_current_context()
    wanted: dict[str, tuple[str, Any]] = {
        "method": ("methods", options.methods),
        "case": ("cases", options.cases),
        "views": ("views", options.views),
        "protocol": ("protocol", options.protocols),
    }
    for key, (option, values) in wanted.items():
        if ctx.get_parameter_source(option) is not ParameterSource.COMMANDLINE:
            continue
        there = dict.fromkeys(row[key] for row in rows)
        lacking = [str(value) for value in values if value not in there]
        if lacking:
            raise UsageError(
                f"{option} {', '.join(lacking)}: {options.out / 'cases.csv'} holds no such row "
                f"but of {', '.join(map(str, there))}; run without --draw-only"
            )
        rows = [row for row in rows if row[key] in values]
    if not rows:
        raise UsageError(f"{options.out / 'cases.csv'} holds no row of all these")
    return rows


def _absolute(path: Path | None) -> Path | None:
    return path if path is None else path.absolute()


def words(text: str) -> tuple[str, ...]:
    """Split at commas; blanks and empty parts go."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


def numbers(text: str) -> tuple[int, ...]:
    """Split at commas into whole numbers.

    Raises
    ------
    UsageError
        Something else stands there.
    """
    try:
        return tuple(int(word) for word in words(text))
    except ValueError:
        raise UsageError(f"{text!r} is not a comma-separated list of whole numbers") from None
