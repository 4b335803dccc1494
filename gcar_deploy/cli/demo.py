"""gcar demo: the case that comes along, from two pictures to a tree, compared with the truth."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from gcar_deploy.cli.common import Talk, engine_options, say_result, talk_options
from gcar_deploy.cli.request import METHOD, order_options
from gcar_deploy.engine_choice import EngineChoice
from gcar_deploy.inputs.order import Order

_FOLDER = Path("gcar-demo")
#: measures that people are told
_SHOWN = ("dsc", "ot_1mm", "chamfer_mm")


@click.command("demo")
@order_options("out", *METHOD, "force")
@engine_options
@talk_options()
def demo(order: Order, engine: EngineChoice, talk: Talk) -> None:
    """Reconstruct a real patient's left coronary tree from two simulated pictures.

    The folder holds the pictures to look at (overlay_view1.png, report.html); a line says how
    well the tree and the truth that the pictures were made from agree. The folder is gcar-demo
    unless --out names another; an earlier demo in it is replaced.

    \b
    Example:
      gcar demo --out demo
    """  # noqa: D301 - click wants a real backspace
    began = time.perf_counter()
    talk.set_up()
    engine.limit_threads()
    from gcar_deploy.beside import allowed_threads, started
    from gcar_deploy.data.demo_case import demo_case
    from gcar_deploy.engine import check_target_of, deliver
    from gcar_deploy.measure.metrics import VOLUME_MEASURES, volume_measures

    case = demo_case()
    target = order.out or _FOLDER
    order = dataclasses.replace(
        order,
        views=tuple(case.pictures),
        geometry=case.geometry,
        out=target,
        force=order.force or _holds_a_demo(target, case.pictures),
    )
    check_target_of(order)
    built = engine.engine(order)
    with talk.bar() as bar:
        result = built.reconstruct_order(order, on_progress=bar)
    names = VOLUME_MEASURES if talk.as_json else _SHOWN
    with allowed_threads(built.threads):
        measured = started(
            lambda: volume_measures(case.truth(), result.volume, result.grid.spacing_mm, names)
        )
    folder = deliver(result, order)
    measures = measured()
    whole = time.perf_counter() - began
    if talk.as_json:
        found = {name: measure.value for name, measure in measures.items()}
        out = {"out": str(folder), "measures": found, "wall_s": whole, **result.summary()}
        text = json.dumps(out, allow_nan=False)
    else:
        text = "\n".join(lines(result, measures, folder, whole))
    say_result(text, folder)


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
