"""What was found in each expert-masked picture, on one page: picture, mask, catheter."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.read import read_picture
from gcar_deploy.output.overlay import grey8, png_bytes
from gcar_deploy.types import Array, Mask
from gcar_export.scenes.expert_pictures import expert_mask

#: found and drawn by the expert, found alone, drawn alone, taken for a catheter (blue, green, red)
_BOTH, _ALONE, _MISSED, _DEVICE = (60, 200, 60), (60, 90, 255), (255, 130, 70), (0, 170, 255)
_LEGEND = (
    "Left: the picture. Right: green found and drawn by the expert, red found alone, blue drawn "
    "alone, orange taken for a catheter, lead or wire, black the centreline."
)


def write_page(seen: Sequence[tuple[Path, VesselImage, Mapping[str, float]]], out: Path) -> Path:
    """Write one HTML file with all pictures inside.

    Parameters
    ----------
    seen : of each picture the path of its expert mask, what was found, its scores
    out : the file
    """
    parts = [
        "<!doctype html><meta charset='utf-8'><title>Vessels of real angiograms</title>",
        "<style>body{font:14px sans-serif}figure{display:inline-block;margin:6px}</style>",
        f"<p>{_LEGEND}</p>",
    ]
    for path, found, scores in seen:
        name = path.name.removesuffix("_gt.png")
        pixels = read_picture(path.with_name(f"{name}.png"))[0]
        drawn = marked(grey8(pixels), found, expert_mask(path))
        data = base64.b64encode(png_bytes(drawn)).decode()
        caption = f"{name}: Dice {scores['Dice']:.2f}, clDice {scores['clDice']:.2f}"
        parts.append(
            f"<figure><img src='data:image/png;base64,{data}'><figcaption>{html.escape(caption)}"
            "</figcaption></figure>"
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text("\n".join(parts) + "\n", encoding="utf-8")
    return out


def marked(grey: Array, found: VesselImage, truth: Mask) -> Array:
    """(rows, 2 cols, 3) uint8, blue, green, red: the picture, and beside it what was found."""
    plain = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    drawn = plain.copy()
    areas = [
        (found.mask & truth, _BOTH), (found.mask & ~truth, _ALONE), (truth & ~found.mask, _MISSED),
    ]  # fmt: skip
    if found.catheter is not None:
        areas.append((found.catheter, _DEVICE))
    for area, colour in areas:
        drawn[area] = (0.45 * drawn[area] + 0.55 * np.array(colour)).astype(np.uint8)
    drawn[found.skeleton] = 0
    return np.hstack([plain, drawn])
