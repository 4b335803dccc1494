"""gcar run VIEW1 VIEW2 ... --geom geom.json --out DIR."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import click

from gcar_deploy.cli.common import (
    ProgressBar,
    backend_options,
    chosen_dicom,
    dicom_options,
    engine_options,
    limit_threads,
    output_options,
    refusals_as_json,
    run_options,
    set_up_logging,
)
from gcar_deploy.cli.hints import given_masks, hint_options, hinted


@click.command("run")
@click.argument(
    "views", nargs=-1, type=click.Path(path_type=Path), metavar="VIEW1 VIEW2 [VIEW3 ...]"
)
@click.option(
    "--geom",
    type=click.Path(path_type=Path),
    help="Geometry of the views (JSON); DICOM has its own.",
)
@click.option(
    "--out", "out_dir", required=True, type=click.Path(path_type=Path), help="New folder."
)
@engine_options
@backend_options
@dicom_options
@hint_options
@click.option("--strict", is_flag=True, help="Take a degraded result for a refusal (exit code 6).")
@click.option("--force", is_flag=True, help="Replace a folder that gcar wrote.")
@click.option("--glb", is_flag=True, help="Write surface.glb as well.")
@click.option(
    "--dicom-stl", is_flag=True, help="Write surface.dcm (DICOM Encapsulated STL) as well."
)
@output_options
def run(
    views: tuple[Path, ...],
    geom: Path | None,
    out_dir: Path,
    predictor: str,
    model: str | None,
    refiner: str,
    deadline: float | None,
    threads: int | None,
    backend: str,
    device: str,
    frame: str,
    spacing: float | None,
    sod: float | None,
    strict: bool,
    force: bool,
    glb: bool,
    dicom_stl: bool,
    verbose: bool,
    quiet: bool,
    as_json: bool,
    **hints: Any,
) -> None:
    """Reconstruct a coronary tree from two or more pictures (PNG, TIFF, NPY, DICOM XA).

    Pictures stand in the order of the views in the geometry file; DICOM runs need none.

    \b
    Example:
      gcar run view1.png view2.png --geom geom.json --out result
      gcar run run1.dcm run2.dcm --out result
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.errors import RefusedError, UsageError

    set_up_logging(verbose, quiet)
    if len(views) < 2:
        raise UsageError(f"{len(views)} picture given; gcar run needs two or more")
    limit_threads(threads)
    from gcar_deploy.output.folder import check_target

    check_target(out_dir, force=force, inputs=(*views, *([geom] if geom else [])))
    from gcar_deploy.engine import Engine
    from gcar_deploy.output.bundle import check_extras

    extras = [name for name, wanted in (("glb", glb), ("dicom-stl", dicom_stl)) if wanted]
    check_extras(extras)
    options = run_options(predictor, refiner, backend, device)
    options = dataclasses.replace(options, dicom=chosen_dicom(frame, spacing, sod))
    options = hinted(options, hints)
    engine = Engine(model, threads=threads, options=options)
    with refusals_as_json(as_json), ProgressBar(quiet=quiet) as bar:
        result = engine.reconstruct(
            list(views), geom, masks=given_masks(hints), on_progress=bar, deadline_s=deadline
        )
    for note in () if quiet else result.notes:
        click.echo(f"gcar: {note}", err=True)
    if strict and result.status != "ok":
        with refusals_as_json(as_json):
            raise RefusedError(f"degraded, and --strict was given: {result.quality.sentence}")
    result.save(out_dir, force=force, extras=extras)
    if as_json:
        click.echo(json.dumps({"out": str(out_dir), **result.summary()}, allow_nan=False))
    else:
        click.echo("\n".join(summary_lines(result, out_dir)))


def summary_lines(result: Any, out_dir: Path) -> list[str]:
    """Return the path first, then a few lines for people."""
    tree = result.tree
    lines = [str(out_dir), f"{result.status}: {result.quality.sentence}"]
    lines.append(
        f"{len(tree.branches)} branches, {tree.length_mm:.0f} mm, "
        f"{len(result.gaussians.means_mm)} Gaussians, {result.seconds['total']:.2f} s"
    )
    for view in result.quality.views:
        coverage = "-" if view.coverage is None else f"{view.coverage:.0%}"
        lines.append(f"view {view.view_id} ({view.name}): {coverage} of the vessels explained")
    return lines
