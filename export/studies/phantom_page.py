"""The phantom's figures as a table and as one page with pictures."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.output.overlay import grey8, png_bytes
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array
from gcar_export.studies.phantom import NEAR_PX, RUNS, Fit, Phantom

_FITTED, _PREDICTED, _SKELETON = (80, 220, 80), (40, 200, 255), (255, 120, 60)
_DEVICE = (60, 60, 255)


def markdown(fits: Sequence[Fit]) -> str:
    """One row a set of runs: the runs that were not fitted, and the authors' surface."""
    out = [
        "| fitted | status | " + " | ".join(RUNS) + " | mean % | tree on skeleton % | tree mm "
        "| ours to the authors' surface: median, 95 % mm | theirs to ours "
        "| rays of landmarks apart mm |",
        "|---" * (len(RUNS) + 8) + "|",
    ]
    for one in fits:
        if one.result is None:
            out.append(f"| {_name(one)} | refused |" + " - |" * (len(RUNS) + 6))
            continue
        shares = {p.name: f"{100 * p.share:.0f}" for p in one.predictions}
        back = np.mean([p.back_share for p in one.predictions])
        gap = one.surface
        near = ("-", "-") if gap is None else (
            f"{gap.ours_median:.2f}, {gap.ours_95:.2f}",
            f"{gap.theirs_median:.2f}, {gap.theirs_95:.2f}",
        )  # fmt: skip
        cells = [
            _name(one), one.result.status, *(shares.get(name, "fitted") for name in RUNS),
            f"{100 * _mean_share(one):.0f}", f"{100 * back:.0f}",
            f"{one.result.tree.length_mm:.0f}", *near,
            "-" if one.marks_mm is None else f"{one.marks_mm:.2f}",
        ]  # fmt: skip
        out.append("| " + " | ".join(cells) + " |")
    pairs = [one for one in fits if len(one.runs) == 2]
    told = [one for one in pairs if one.result is not None]
    if told:
        shares_of = [_mean_share(one) for one in told]
        out += [
            "",
            f"{len(pairs)} pairs, {len(pairs) - len(told)} refused; of the others "
            f"{100 * np.mean(shares_of):.1f} % of the unseen runs' lines lie within {NEAR_PX:g} px "
            f"on average, {100 * min(shares_of):.0f} % from the worst.",
        ]
    return "\n".join(out)


def _mean_share(one: Fit) -> float:
    return float(np.mean([p.share for p in one.predictions]))


def write_page(phantom: Phantom, fits: Sequence[Fit], out: Path) -> Path:
    """Write ``index.html`` with all pictures inside into the folder ``out``."""
    parts = [
        "<!doctype html><meta charset='utf-8'><title>Phantom</title>",
        "<style>body{font:15px/1.5 sans-serif;max-width:1200px;margin:2em auto;padding:0 1em}"
        "figure{display:inline-block;margin:0 12px 12px 0;width:370px;vertical-align:top}"
        "img{width:370px}pre{overflow:auto}</style>",
        "<h1>Real X-rays of a physical coronary phantom</h1>",
        "<p>Data: Vukicevic et al., Sci Rep 8:1711 (2018), Dataset I. Blue: skeleton found in "
        "the picture. Red: taken for a catheter or wire and left out. "
        "Green: tree in a run that it was fitted to. Yellow: tree in a run that it "
        "never saw, after one shift of the run as a whole. The authors report 0.03 to 2.46 mm "
        "between their surface and CT.</p>",
        f"<pre>{html.escape(markdown(fits))}</pre>",
    ]
    for one in fits:
        parts.append(f"<h2>{html.escape(_name(one))}</h2>")
        if one.result is None:
            parts.append(f"<p>Refused: {html.escape(one.refusal)}</p>")
            continue
        parts.append(f"<p>{html.escape(one.result.status)}: "
                     f"{html.escape(one.result.quality.sentence)}</p>")  # fmt: skip
        for name, view in zip(one.runs, one.result.views, strict=True):
            parts.append(_figure(phantom, name, view, view.carm, one.result.tree, _FITTED))
        for p in one.predictions:
            parts.append(
                _figure(phantom, p.name, phantom.vessels[p.name], p.carm, one.result.tree,
                        _PREDICTED, f"{p.share:.0%} within {NEAR_PX:g} px, median "
                        f"{p.median_px:.1f} px")
            )  # fmt: skip
    page = out / "index.html"
    page.write_text("\n".join(parts) + "\n", encoding="utf-8")
    return page


def _name(one: Fit) -> str:
    marked = one.result is not None and one.result.options.landmarks
    return " + ".join(one.runs) + (" (landmarks)" if marked else "")


def _figure(
    phantom: Phantom, name: str, view: VesselImage, carm: CArm, tree: Tree,
    color: tuple[int, int, int], words: str = "fitted",
) -> str:  # fmt: skip
    picture = base64.b64encode(
        png_bytes(draw(phantom.angiograms[name].pixels, view, carm, tree, color))
    ).decode()
    return (
        f"<figure><img alt='{name}' src='data:image/png;base64,{picture}'>"
        f"<figcaption>{name}, {html.escape(carm.clinical_name())}: {html.escape(words)}"
        "</figcaption></figure>"
    )


def draw(
    pixels: Array, view: VesselImage, carm: CArm, tree: Tree, color: tuple[int, int, int]
) -> Array:
    """(rows, cols, 3) uint8: picture, its skeleton, catheter, the tree as ``carm`` sees it."""
    canvas = cv2.cvtColor((0.7 * grey8(pixels)).astype(np.uint8), cv2.COLOR_GRAY2BGR)
    if view.catheter is not None:
        canvas[view.catheter] = _DEVICE
    canvas[view.skeleton & view.valid] = _SKELETON
    for branch in tree.branches:
        line = np.clip(carm.project(branch.points_mm)[0], -4000, 4000)
        cv2.polylines(canvas, [np.rint(16 * line).astype(np.int32)], False, color, 1, 16, 4)
    return canvas
