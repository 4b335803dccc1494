"""``gcar validate``: look at pictures and geometry without reconstructing."""

from __future__ import annotations

import json
from typing import Any

import click

from gcar_deploy.cli.common import chosen_dicom, dicom_options
from gcar_deploy.cli.hints import hinted, reading_options

EXAMPLE = "Example:\n\n  gcar validate view1.png view2.png --geom geom.json"


@click.command(epilog=EXAMPLE, short_help="Check pictures and geometry without reconstructing.")
@click.argument("pictures", nargs=-1, required=True, type=click.Path(dir_okay=False))
@click.option("--geom", type=click.Path(dir_okay=False), help="Scene file; DICOM has its own.")
@dicom_options
@reading_options
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def validate(
    pictures: tuple[str, ...],
    geom: str | None,
    frame: str,
    spacing: float | None,
    sod: float | None,
    as_json: bool,
    **hints: Any,
) -> None:
    """Check PICTURES and the scene file without reconstructing.

    Says how far apart the views are, how they magnify, how much of the volume each covers,
    whether they can show the same tree, and what ``gcar run`` would refuse and why; ends with
    the exit code that ``gcar run`` would give.
    """
    from gcar_deploy.config import RunOptions
    from gcar_deploy.errors import GcarError
    from gcar_deploy.inspection import inspect_files

    options = hinted(RunOptions(dicom=chosen_dicom(frame, spacing, sod)), hints)
    found = inspect_files(pictures, geom, options)
    click.echo(json.dumps(found.to_dict()) if as_json else "\n".join(_lines(found)))
    if found.error is not None:
        error: GcarError = found.error
        raise error


def _lines(found: Any) -> list[str]:
    out = []
    for view in found.views:
        out.append(
            f"view {view['id']}  {view['name']:<16} magnification {view['magnification']:.2f}, "
            f"pixel {view['pixel_at_isocenter_mm']:.3f} mm at the isocentre, "
            f"sees {view['coverage']:.0%} of the volume"
        )
        if view["vessel_share"] is not None:
            out.append(f"        vessel on {view['vessel_share']:.1%} of the picture")
    for pair in found.pairs:
        line = f"views {pair['first']} and {pair['second']}: {pair['separation_deg']:.1f} deg apart"
        if pair["disagreement"] is not None:
            line += (
                f"; vessel mass along the epipolar lines differs by {pair['disagreement']:.1%}"
                f" (best shift {pair['shift_mm']:+.1f} mm leaves {pair['after_shift']:.1%})"
            )
        out.append(line)
    out += [f"warning: {text}" for text in found.warnings]
    out += [f"silent: {text}" for text in found.silent]
    out.append("would be refused" if found.error is not None else "would be reconstructed")
    return out
