"""gcar info PATH: what a result folder or a model is, and whether it is still what was written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from gcar_deploy.cli.common import ToldError
from gcar_deploy.cli.paths import ANY_PATH


@click.command("info")
@click.argument("path", type=ANY_PATH, metavar="RESULT_DIR|MODEL")
@click.option("--json", "as_json", is_flag=True, help="Print the content as one JSON object.")
def info(path: Path, as_json: bool) -> None:
    """Print what a result folder holds, or a model's card, and check files against their hashes.

    \b
    Example:
      gcar info result
      gcar info models/gcp-multi.onnx
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.errors import UsageError

    if path.suffix == ".onnx":
        from gcar_deploy.imaging.net import KIND as SEGMENTER
        from gcar_deploy.models import model_card, read_model
        from gcar_deploy.predict import PREDICTOR_KINDS

        model = read_model(path, (*PREDICTOR_KINDS.values(), SEGMENTER))
        click.echo(json.dumps(model.spec) if as_json else "\n".join(model_card(model)))
        return
    from gcar_deploy.output.stored import altered_files, as_written, read_summary

    summary = read_summary(path)
    with as_written(path):
        altered = altered_files(path, summary)
        told = [] if as_json else lines(path, summary)
    if as_json:
        told = [json.dumps({**summary, "altered": altered}, allow_nan=False)]
    click.echo("\n".join(told))
    if altered:
        raise ToldError(UsageError(f"{path}: not as it was written: {', '.join(altered)}"))


def names_of(branches: list[dict[str, Any]]) -> str:
    """Named vessels with their length and least confidence, or that there is none."""
    found: dict[str, list[dict[str, Any]]] = {}
    for branch in branches:
        if branch.get("name"):
            found.setdefault(branch["name"], []).append(branch)
    return (
        ", ".join(
            f"{name} {sum(b['length_mm'] for b in own):.0f} mm "
            f"({int(100 * min(b['name_confidence'] for b in own))} %)"
            for name, own in found.items()
        )
        or "none is probable enough; branches have numbers"
    )


def lines(path: Path, summary: dict[str, Any]) -> list[str]:
    """Return the summary for people."""
    from gcar_deploy.output.words import explained

    tree, counts = summary["tree"], summary["counts"]
    made_by = {  # results of earlier versions do not name the segmenter
        key: "none" if summary.get(key) is None
        else f"{summary[key]['name']} {summary[key]['sha256'][:12]}"
        for key in ("model", "segmenter")
    }  # fmt: skip
    out = [
        f"{path}: {summary['status']}",
        f"  {summary['sentence']}",
        f"  tree: {len(tree['branches'])} branches, {tree['length_mm']:.0f} mm, "
        f"{counts['gaussians']} Gaussians",
        f"  names: {names_of(tree['branches'])}",
        f"  made by: {summary['predictor']} + {summary['refiner']}, model {made_by['model']}, "
        f"segmenter {made_by['segmenter']}, gcar {summary['versions'].get('gcar')}",
        f"  views {summary['separation_deg']:.1f} deg apart; {summary['seconds']['total']:.2f} s",
    ]
    for view in summary["views"]:
        even = view.get("coverage_even")
        told = explained(view["coverage"], even, view.get("left_out", 0.0))
        out.append(f"  view {view['id']} ({view['name']}): {told}")
    out.append(f"  files: {', '.join(summary.get('files', {}))}")
    out.append(f"  {summary['use']}")
    return out
