"""gcar demo: the case that comes along, from two pictures to a tree, compared with the truth."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from gcar_deploy.cli.common import (
    ProgressBar,
    backend_options,
    engine_options,
    limit_threads,
    output_options,
    run_options,
    set_up_logging,
)


@click.command("demo")
@click.option(
    "--out",
    "out_dir",
    default="gcar-demo",
    show_default=True,
    type=click.Path(path_type=Path),
    help="New folder.",
)
@engine_options
@backend_options
@click.option("--force", is_flag=True, help="Replace any result of gcar.")
@output_options
def demo(
    out_dir: Path,
    predictor: str,
    model: str | None,
    refiner: str,
    deadline: float | None,
    threads: int | None,
    backend: str,
    device: str,
    force: bool,
    verbose: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Reconstruct a real patient's left coronary tree from two simulated pictures.

    The folder holds the pictures to look at (overlay_view1.png, report.html); the table
    compares the tree with the truth that the pictures were made from. An earlier demo in the
    folder is replaced.

    \b
    Example:
      gcar demo --out demo
    """  # noqa: D301 - click wants a real backspace
    started = time.perf_counter()
    set_up_logging(verbose, quiet)
    limit_threads(threads)
    from gcar_deploy.data.demo_case import demo_case
    from gcar_deploy.output.folder import check_target

    case = demo_case()
    force = force or _holds_a_demo(out_dir, case.pictures)
    check_target(out_dir, force=force)
    from gcar_deploy.engine import Engine
    from gcar_deploy.measure.metrics import volume_measures

    engine = Engine(
        model, threads=threads, options=run_options(predictor, refiner, backend, device)
    )
    with ProgressBar(quiet=quiet) as bar:
        result = engine.reconstruct(
            case.pictures, case.geometry, on_progress=bar, deadline_s=deadline
        )
    measures = volume_measures(
        case.truth(), result.volume, result.grid.spacing_mm, structure=as_json
    )
    result.save(out_dir, force=force)
    whole = time.perf_counter() - started
    if as_json:
        found = {name: measure.value for name, measure in measures.items()}
        out = {"out": str(out_dir), "measures": found, "wall_s": whole, **result.summary()}
        click.echo(json.dumps(out, allow_nan=False))
    else:
        click.echo("\n".join(lines(result, measures, out_dir, whole)))


def _holds_a_demo(folder: Path, pictures: Sequence[Path]) -> bool:
    """Whether a folder holds a result of the demo's own pictures, which anyone can make again."""
    from gcar_deploy.output.folder import manifest_of

    views = (manifest_of(folder) or {}).get("views", [])
    own = [hashlib.sha256(path.read_bytes()).hexdigest() for path in pictures]
    return [view["picture"]["sha256"] for view in views] == own


def lines(result: Any, measures: Any, out_dir: Path, whole: float) -> list[str]:
    """Return the outcome for people."""

    def shown(name: str, pattern: str) -> str:
        measure = measures[name]
        return f"- ({measure.reason})" if measure.value is None else pattern.format(measure.value)

    return [
        f"{result.status}: {result.quality.sentence}",
        f"tree: {len(result.tree.branches)} branches, {result.tree.length_mm:.0f} mm",
        "compared with the truth: "
        f"volume DSC at 0.5 {shown('dsc', '{:.1%}')}, Ot(1 mm) {shown('ot_1mm', '{:.1%}')}, "
        f"Chamfer {shown('chamfer_mm', '{:.2f} mm')}",
        f"time: {result.seconds['total']:.2f} s from pictures to tree, {whole:.2f} s in all",
        f"picture: {out_dir / 'overlay_view1.png'}",
        f"report: {out_dir / 'report.html'}",
    ]
