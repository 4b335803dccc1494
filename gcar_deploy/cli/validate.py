"""``gcar validate``: look at pictures and geometry without reconstructing."""

from __future__ import annotations

import json
from typing import Any

import click

from gcar_deploy.cli.common import Talk, ToldError, talk_options
from gcar_deploy.cli.paths import pictures
from gcar_deploy.cli.request import READING, order_options
from gcar_deploy.inputs.order import Order


@click.command(short_help="Check pictures and geometry without reconstructing.")
@pictures("views", metavar="VIEW1 VIEW2 ...")
@order_options(*READING, "predictor", "file")
@talk_options("as_json")
def validate(order: Order, talk: Talk) -> None:
    """Check pictures and their geometry without reconstructing.

    Says how far apart the views are, how they magnify, how much of the volume each covers,
    whether they can show the same tree, and what ``gcar run`` would refuse and why before it
    makes a tree; ends with the exit code that ``gcar run`` would give then.

    \b
    Example:
      gcar validate view1.png view2.png --geom geom.json
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.config import RunOptions
    from gcar_deploy.inputs.order import check_view_numbers
    from gcar_deploy.inspection import inspect_files

    check_view_numbers(order)
    options = order.options(RunOptions())
    found = inspect_files(order.views, order.geometry, options, order.masks, order.drawn)
    click.echo(json.dumps(found.to_dict()) if talk.as_json else "\n".join(_lines(found)))
    if found.error is not None:
        raise ToldError(found.error)


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
