"""``gcar-export centers-table`` and ``robustness``: parse, call one function, print."""

from __future__ import annotations

from pathlib import Path

import click

from gcar_export.cli.evaluate import words
from gcar_export.cli.options import FOLDER, OUT_FOLDER

_CASES = click.option("--cases", default="", help="Only these cases, comma-separated.")


@click.command("centers-table")
@click.option("--data", type=FOLDER, required=True, help="Folder with label volumes.")
@click.option(
    "--protocol",
    type=click.Choice(["paper", "clinical", "moved", "raw"]),
    default="paper",
    show_default=True,
)
@click.option(
    "--models",
    default="multi,paper",
    show_default=True,
    help="Comma-separated: multi, paper (the shipped ones), or paths.",
)
@_CASES
@click.option("--no-cost", is_flag=True, help="Leave time and memory away.")
def centers_table(data: Path, protocol: str, models: str, cases: str, no_cost: bool) -> None:
    """Compare predicted centres with the truth: within 1.5 voxels, both ways; time and memory.

    Example: gcar-export centers-table --data data --protocol clinical --models multi,paper
    """
    from gcar_export.studies import centers_table as centers

    opened = centers.open_models(words(models))
    rows = centers.measure(data, protocol, opened, words(cases), _progress)
    costs = [] if no_cost else centers.cost(data, protocol, opened, words(cases))
    click.echo(centers.table(rows, costs, protocol))


@click.command()
@click.option("--data", type=FOLDER, required=True, help="Folder with label volumes.")
@_CASES
@click.option(
    "--curves",
    default="separation,angle,shift,mask,gaps",
    show_default=True,
    help="Comma-separated.",
)
@click.option(
    "--model", type=click.Path(path_type=Path), help="ONNX file; the shipped one without."
)
@click.option("--out", type=OUT_FOLDER, required=True, help="CSV, PNG, table.")
def robustness(data: Path, cases: str, curves: str, model: Path | None, out: Path) -> None:
    """Curves over separation, geometry error and mask noise, through the whole reconstruction.

    Goes on where an earlier run with the same --out stopped.

    Example: gcar-export robustness --data data --cases 0001,0134,0595 --out robustness
    """
    from gcar_export.studies import robustness as curves_of

    rows = curves_of.run(
        data, out, cases=words(cases), curves=words(curves), model=model, progress=_progress
    )
    click.echo(curves_of.table(rows))


def _progress(done: int, total: int, text: str) -> None:
    click.echo(f"[{done}/{total}] {text}", err=True)
