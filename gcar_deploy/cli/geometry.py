"""gcar geometry: a scene file from DICOM headers, and a scene file in words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from gcar_deploy.cli.common import Talk, say, talk_options
from gcar_deploy.cli.paths import ANY_PATH, GEOMETRY, pictures
from gcar_deploy.cli.request import order_options
from gcar_deploy.inputs.order import Order


@click.group("geometry")
def geometry() -> None:
    """Read or show where the views were taken from.

    \b
    Example:
      gcar geometry from-dicom run1.dcm run2.dcm --out geom.json
      gcar geometry show geom.json
    """  # noqa: D301 - click wants a real backspace


@geometry.command("from-dicom")
@pictures("views", metavar="RUN1 RUN2 [RUN3 ...]")
@order_options("frames", "pixel_spacing_mm", "sod_mm")
@click.option("--out", "out_file", type=ANY_PATH, help="New file; else it is printed.")
def from_dicom(order: Order, out_file: Path | None) -> None:
    """Read the geometry in the headers of DICOM XA runs as the text of a geom.json.

    \b
    Example:
      gcar geometry from-dicom run1.dcm run2.dcm --out geom.json
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.config import RunOptions
    from gcar_deploy.dicom.scene import read_views
    from gcar_deploy.errors import UsageError
    from gcar_deploy.files import is_there, whole_file
    from gcar_deploy.geometry.scene import scene_to_json

    if len(order.views) < 2:
        raise UsageError(f"{len(order.views)} run given; a geometry needs two or more")
    if out_file is not None and is_there(out_file):
        raise UsageError(f"{out_file} exists; name a new file")
    _, scene, notes = read_views(list(order.views), order.options(RunOptions()).dicom)
    for note in notes:
        say(f"gcar: {note}")
    if out_file is None:
        click.echo(scene_to_json(scene), nl=False)
        return
    try:
        with whole_file(out_file) as partial:
            partial.write_text(scene_to_json(scene), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{out_file} cannot be written ({error.strerror})") from None
    click.echo(str(out_file))


@geometry.command("show")
@click.argument("path", type=GEOMETRY, metavar="GEOM_JSON")
@talk_options("as_json")
def show(path: Path, talk: Talk) -> None:
    """Say in words what a scene file holds, and what its views cannot see.

    \b
    Example:
      gcar geometry show geom.json
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.geometry.scene import load_scene
    from gcar_deploy.inspection import describe_scene

    found = describe_scene(load_scene(path))
    click.echo(json.dumps(found) if talk.as_json else "\n".join(_lines(found)))


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
