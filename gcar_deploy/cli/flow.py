"""gcar flow RESULT: pressure drop at an assumed flow, and the tree as flow solvers take it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gcar_deploy.cli.common import Talk, gathered, say, talk_options
from gcar_deploy.cli.paths import ANY_PATH
from gcar_deploy.errors import UsageError

if TYPE_CHECKING:
    from gcar_deploy.flow import Assumption


def _assumption(**given: Any) -> Assumption:
    from gcar_deploy.flow import Assumption

    if given["velocity_m_s"] is not None and given["flow_ml_min"] is not None:
        raise UsageError("--velocity and --flow both say how much flows: give one of them")
    return Assumption(**{name: value for name, value in given.items() if value is not None})


_ASSUMED = {
    "aortic_pressure_mmhg": click.option(
        "--aortic-pressure", "aortic_pressure_mmhg", type=float, metavar="MMHG",
        show_default="90", help="Mean pressure Pa at the inlet.",
    ),
    "flow_sigma": click.option(
        "--flow-sigma", type=float, metavar="SHARE",
        help="Relative standard deviation of the flow; 0.2 with a velocity, 0 with --flow.",
    ),
    "flow_ml_min": click.option(
        "--flow", "flow_ml_min", type=float, metavar="ML/MIN",
        help="Flow through the inlet, if it is known.",
    ),
    "velocity_m_s": click.option(
        "--velocity", "velocity_m_s", type=float, metavar="M/S", show_default="0.35",
        help="Mean velocity at the inlet in hyperaemia.",
    ),
}  # fmt: skip


@click.command("flow")
@click.argument("result", type=ANY_PATH, metavar="RESULT_DIR")
@gathered("assumed", _assumption, _ASSUMED)
@click.option(
    "--out", type=ANY_PATH, metavar="DIR",
    help="New folder for picture, open surface with caps, centreline and 0D model.",
)  # fmt: skip
@click.option("--force", is_flag=True, help="Replace a folder that gcar wrote.")
@talk_options("as_json")
def flow(result: Path, assumed: Assumption, out: Path | None, force: bool, talk: Talk) -> None:
    """Tell Pd/Pa along each vessel at an assumed hyperaemic flow, as an interval.

    Closed forms on the tree of a result folder: Poiseuille's law with taper, and the loss behind
    each narrowing. No flow and no pressure is measured, so this is not a fractional flow reserve.
    A value is withheld, with the reason, where the result is degraded or the interval is wider
    than 0.1. With --out also what flow solvers take (docs/flow.md).

    \b
    Example:
      gcar flow result
      gcar flow result --flow 200 --aortic-pressure 85
      gcar flow result --out model
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.flow import doubts_of, pressure_drop, pressure_table
    from gcar_deploy.measure import lumen_tree
    from gcar_deploy.measure.lumen import tree_lumens
    from gcar_deploy.output.folder import check_target
    from gcar_deploy.output.stored import as_written, read_folder

    if out is not None:
        check_target(out, force=force, inputs=(result,))
    stored = read_folder(result)
    told = stored.summary
    tree, sections = stored.lumen or lumen_tree(stored.tree, None)
    found = told.get("ambiguity", {}).get("probable_ghosts", ())
    with as_written(result):
        ghosts = {ghost["branch"] - 1: ghost["probability"] for ghost in found}
        doubts = doubts_of(told["status"], len(tree.branches), ghosts)
    names = [branch.get("name") for branch in told["tree"]["branches"]]
    drop = pressure_drop(tree, tree_lumens(tree, sections), assumed, doubts, names)
    table = pressure_table(drop)
    if out is not None:
        from gcar_deploy.output.handover import write_handover

        for note in write_handover(tree, drop, out, force=force):
            say(f"gcar: {note}")
    if talk.as_json:
        click.echo(json.dumps(table, allow_nan=False))
    else:
        click.echo("\n".join([*([] if out is None else [str(out)]), *lines(table, names)]))


def lines(table: dict[str, Any], names: list[str | None]) -> list[str]:
    """Return the table for people."""
    out = [
        table["sentence"],
        f"{table['coverage']:.0%} intervals. Inlet flow {table['inlet_flow_ml_min']:.0f} ml/min.",
        "branch      from - to mm   ml/min   Pd/Pa   interval      loss mmHg",
    ]
    for row, name in zip(table["branches"], names, strict=True):
        title = f"{row['branch']} {name}" if name else str(row["branch"])
        flow = "-" if row["flow_ml_min"] is None else f"{row['flow_ml_min']:.1f}"
        line = f"{title:<10}{row['from_mm']:7.1f} - {row['to_mm']:5.1f}  {flow:>6}   "
        if row["withheld"]:
            out.append(f"{line}withheld: {row['withheld']}")
            continue
        low, high = row["interval"]
        out.append(f"{line}{row['pd_pa']:.3f}   {low:.3f}-{high:.3f}   {row['drop_mmhg']:9.1f}")
    return out
