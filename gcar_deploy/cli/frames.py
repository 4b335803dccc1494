"""gcar frames RUN1 RUN2: which frames of two runs show the heart in one phase."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gcar_deploy.cli.common import Talk, talk_options
from gcar_deploy.cli.paths import pictures
from gcar_deploy.cli.request import order_options
from gcar_deploy.inputs.order import Order

if TYPE_CHECKING:
    from gcar_deploy.imaging.chosen_frame import FramePair

#: pairs in the table
_BEST = 8


@click.command("frames")
@pictures("runs", count=2, metavar="RUN1 RUN2")
@order_options("geometry", "frames", "pixel_spacing_mm", "sod_mm", "allow_rescale", "out", "force")
@talk_options("as_json", "quiet")
def frames(runs: tuple[Path, Path], order: Order, talk: Talk) -> None:
    """Find the frames of two runs that show the heart in one phase.

    A run is a DICOM file, a folder of pictures or a TIFF of several pages. Of the frames that are
    filled with contrast and fairly still, every pair is scored by how alike the contrast is spread
    over the epipolar planes, frames before and after included; no ECG is needed, but R waves
    that both files name go first. The margin says how far the pair is ahead of the best one in
    which either run shows another shape of the heart. gcar run takes this pair; where hardly
    anything moves, as in a phantom, its own choice for each run is told instead.

    With --out DIR: frames.png (scores of all pairs, the chosen frames beside them), frames.json,
    frame_view1.png, frame_view2.png.

    \b
    Example:
      gcar frames run1.dcm run2.dcm
      gcar frames frames1 frames2 --geom geom.json --out pairs
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.config import RunOptions
    from gcar_deploy.errors import GeometryError
    from gcar_deploy.geometry.scene import load_scene
    from gcar_deploy.inputs.runs import compared
    from gcar_deploy.output.folder import check_target, write_folder

    if order.out is not None:
        check_target(order.out, force=order.force, inputs=runs)
    options = order.options(RunOptions())
    scene = load_scene(order.geometry) if isinstance(order.geometry, Path) else None
    if scene is not None and len(scene.views) != 2:
        raise GeometryError(f"the geometry has {len(scene.views)} views; two are needed")
    with talk.bar() as bar:
        pair, seen, beats = compared(
            runs, scene, options, lambda share: bar("frames", min(share, 0.99))
        )
    told = _told(pair, beats)
    if order.out is not None:
        from gcar_deploy.output.frame_pictures import counts_png, pairs_png

        reads = [run.cine.read(k) for run, k in zip(seen, pair.chosen, strict=True)]
        times = [run.cine.frame_ms for run in seen]
        files = {
            "frames.png": pairs_png(pair, (reads[0][0], reads[1][0]), times),
            "frames.json": (json.dumps(told, indent=1, allow_nan=False) + "\n").encode(),
        }
        for number, (pixels, depth, _) in enumerate(reads, start=1):
            files[f"frame_view{number}.png"] = counts_png(pixels, depth)
        write_folder(order.out, files, force=order.force)
    click.echo(json.dumps(told, allow_nan=False) if talk.as_json else "\n".join(_lines(told)))


def _told(pair: FramePair, beats: dict[str, bool]) -> dict[str, Any]:
    """JSON values; frames count from 1."""
    i, j = pair.chosen
    return {
        "schema": "gcar-frames/1",
        "frames": [i + 1, j + 1],
        "score": pair.score,
        "margin": pair.margin,
        "moves": [beats["1"], beats["2"]],
        "scores": pair.scores.round(4).tolist(),
        "remaining": pair.remaining.tolist(),
        "filling": [share.round(4).tolist() for share in pair.filling],
        "motion": [share.round(4).tolist() for share in pair.motion],
    }


def _lines(told: dict[str, Any]) -> list[str]:
    scores, remaining = told["scores"], told["remaining"]
    pairs = [
        (score, i, j)
        for i, row in enumerate(scores)
        for j, score in enumerate(row)
        if remaining[i][j]
    ]
    out = ["run 1  run 2  score  contrast     motion"]
    for score, i, j in sorted(pairs, key=lambda one: -one[0])[:_BEST]:
        (a, b), (x, y) = ((told[key][0][i], told[key][1][j]) for key in ("filling", "motion"))
        out.append(f"{i + 1:5d}  {j + 1:5d}  {score:5.2f}  {a:4.0%} {b:4.0%}   {x:4.0%} {y:4.0%}")
    first, second = told["frames"]
    margin = told["margin"]
    out += [
        f"run {number}: hardly anything moves: no pair is better than another"
        for number, moves in enumerate(told["moves"], start=1) if not moves
    ]  # fmt: skip
    if not all(told["moves"]):
        how = "each chosen by itself"
    else:
        how = "no other phase to compare with" if margin is None else f"margin {margin:.3f}"
    out.append(f"frames {first} and {second}: score {told['score']:.2f}, {how}")
    out.append(f"gcar run ... --frame {first},{second}")
    return out
