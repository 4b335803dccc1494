"""gcar geometry: a scene file from DICOM headers, and a scene file in words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from gcar_deploy.cli.common import chosen_dicom, dicom_options


@click.group("geometry")
def geometry() -> None:
    """Read or show where the views were taken from.

    \b
    Example:
      gcar geometry from-dicom run1.dcm run2.dcm > geom.json
      gcar geometry show geom.json
    """  # noqa: D301 - click wants a real backspace


@geometry.command("from-dicom")
@click.argument("runs", nargs=-1, type=click.Path(path_type=Path), metavar="RUN1 RUN2 [RUN3 ...]")
@dicom_options
def from_dicom(
    runs: tuple[Path, ...], frame: str, spacing: float | None, sod: float | None
) -> None:
    """Print the geometry in the headers of DICOM XA runs as the text of a geom.json.

    \b
    Example:
      gcar geometry from-dicom run1.dcm run2.dcm > geom.json
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.dicom.scene import read_views
    from gcar_deploy.errors import UsageError
    from gcar_deploy.geometry.scene import scene_to_json

    if len(runs) < 2:
        raise UsageError(f"{len(runs)} run given; a geometry needs two or more")
    _, scene, notes = read_views(list(runs), chosen_dicom(frame, spacing, sod))
    for note in notes:
        click.echo(f"gcar: {note}", err=True)
    click.echo(scene_to_json(scene), nl=False)


@geometry.command("show")
@click.argument("path", type=click.Path(path_type=Path), metavar="GEOM_JSON")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def show(path: Path, as_json: bool) -> None:
    """Say in words what a scene file holds, and what its views cannot see.

    \b
    Example:
      gcar geometry show geom.json
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.geometry.scene import load_scene
    from gcar_deploy.inspection import describe_scene

    found = describe_scene(load_scene(path))
    click.echo(json.dumps(found) if as_json else "\n".join(_lines(found)))


def _lines(found: dict[str, Any]) -> list[str]:
    out = []
    for view in found["views"]:
        spacing = " x ".join(f"{x:g}" for x in view["pixel_spacing_mm"])
        out.append(
            f"view {view['id']}  {view['name']:<16} SOD {view['sod_mm']:g} mm, SDD "
            f"{view['sdd_mm']:g} mm, {view['rows']} x {view['columns']} pixels of {spacing} mm "
            f"({view['pixel_at_isocenter_mm']:.3f} mm at the isocentre), {view['kind']}"
        )
    for pair in found["pairs"]:
        out.append(
            f"views {pair['first']} and {pair['second']}: {pair['separation_deg']:.1f} deg apart"
        )
    volume = found["volume"]
    size, shape = (" x ".join(f"{x:g}" for x in volume[k]) for k in ("size_mm", "shape"))
    out.append(f"volume: {size} mm, {shape} voxels" + ("" if volume["given"] else " (by default)"))
    out += [f"warning: {text}" for text in found["warnings"]]
    out += [f"silent: {text}" for text in found["silent_errors"]]
    return out
