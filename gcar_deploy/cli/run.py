"""gcar run VIEW1 VIEW2 ... --geom geom.json --out DIR."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gcar_deploy.cli.common import Talk, engine_options, say_result, talk_options
from gcar_deploy.cli.paths import ANY_PATH, pictures
from gcar_deploy.cli.request import EXTRA_FILES, METHOD, READING, order_options
from gcar_deploy.engine_choice import EngineChoice
from gcar_deploy.inputs.order import Order, check_view_numbers, order_to_json

if TYPE_CHECKING:
    from gcar_deploy.steps import OnStep


@click.command("run")
@pictures("views", metavar="VIEW1 VIEW2 [VIEW3 ...]")
@order_options("out", *METHOD, *READING, "lesions", "strict", "force", *EXTRA_FILES, "file")
@click.option("--print-order", is_flag=True, help="Print the order as JSON and do nothing else.")
@click.option(
    "--keep-steps",
    type=ANY_PATH,
    metavar="DIR",
    help="New folder for what every stage made: pictures and VTP.",
)
@engine_options
@talk_options()
def run(
    order: Order, engine: EngineChoice, talk: Talk, print_order: bool, keep_steps: Path | None
) -> None:
    """Reconstruct a coronary tree from two or more pictures (PNG, TIFF, NPY, DICOM XA).

    Pictures stand in the order of the views in the geometry file; DICOM runs need none. All that
    is asked for can be kept as an order, done again, or sent to a worker.

    \b
    Example:
      gcar run view1.png view2.png --geom geom.json --out result
      gcar run run1.dcm run2.dcm --out result
      gcar run run1.dcm run2.dcm --pixel-spacing 0.3 --out result --print-order > order.json
      gcar run --order order.json --force
    """  # noqa: D301 - click wants a real backspace
    talk.set_up()
    check_view_numbers(order)
    if print_order:
        # Wherever the text is put, it names the same files.
        click.echo(order_to_json(order.relative_to(Path.cwd()).with_drawn_on()), nl=False)
        return
    engine.limit_threads()
    from gcar_deploy.engine import check_target_of, deliver

    out = check_target_of(order)
    on_step = None if keep_steps is None else _step_folder(keep_steps, out)
    with talk.bar() as bar:
        result = engine.engine(order).reconstruct_order(order, on_progress=bar, on_step=on_step)
    talk.note(result.notes)
    folder = deliver(result, order)
    if talk.as_json:
        text = json.dumps({"out": str(folder), **result.summary()}, allow_nan=False)
    else:
        text = "\n".join(summary_lines(result, folder))
    say_result(text, folder)


def _step_folder(folder: Path, out: Path) -> OnStep:
    from gcar_deploy.errors import UsageError
    from gcar_deploy.output.step_folder import StepFolder

    if out.resolve() in (folder.resolve(), *folder.resolve().parents):
        raise UsageError(f"--keep-steps {folder} lies in --out; name a folder beside it")
    return StepFolder(folder)


def summary_lines(result: Any, out_dir: Path) -> list[str]:
    """Return the path first, then a few lines for people."""
    from gcar_deploy.output.words import explained

    tree = result.tree
    lines = [str(out_dir), f"{result.status}: {result.quality.sentence}"]
    lines.append(
        f"{len(tree.branches)} branches, {tree.length_mm:.0f} mm, "
        f"{len(result.gaussians.means_mm)} Gaussians, {result.seconds['total']:.2f} s"
    )
    for view in result.quality.views:
        told = explained(view.coverage, view.coverage_even, view.left_out)
        lines.append(f"view {view.view_id} ({view.name}): {told}")
    return lines
