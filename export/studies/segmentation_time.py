"""Seconds per picture of finding vessels, beside one itk-rtk projection pair of the same run."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping

import numpy as np

from gcar_deploy.config import SEGMENTERS, ImagingOptions, SegmenterName
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.imaging.net import Segmenter
from gcar_export.methods.rtk_timing import pair_carms, projection_pair
from gcar_export.scenes.protocols import case_geometry
from gcar_export.scenes.raw_pictures import raw_picture
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.trees import random_tree

SEED = 51_200
PAIR = "itk-rtk pair"


def pictures(trees: int) -> list[Angiogram]:
    """First clinical view, 512 x 512 pixels, of generated left trees as raw pictures."""
    carm = case_geometry("clinical", 2)[0][0]
    out = []
    for number in range(trees):
        rng = np.random.default_rng([SEED, number])
        path = path_lengths(carm, *random_tree(rng).sides("left").segments())
        out.append(
            Angiogram(
                view_id="1", carm=carm, pixels=raw_picture(path, rng).astype(np.float32),
                bit_depth=8, intensity=Intensity(kind="raw", polarity="dark"), sha256=str(number),
            )
        )  # fmt: skip
    return out


def rtk_pair() -> Callable[[], None] | None:
    """One forward and one back projection, 128^3 voxels and two 128 x 128 views.

    None without itk-rtk.
    """
    grid = case_geometry("paper", 2)[1]
    try:
        forward, back = projection_pair(np.ones(grid.shape, np.float32), grid, pair_carms())
    except ImportError:
        return None

    def both() -> None:
        forward()
        back()

    return both


def timed(
    net: Segmenter | None, pair: Callable[[], None] | None, trees: int = 3, repeats: int = 3
) -> dict[str, float]:
    """Median seconds by method, and of the pair; all in turns, after one untimed round."""

    def asking(who: SegmenterName) -> Callable[[Angiogram], object]:
        return lambda picture: extract_vessels(picture, ImagingOptions(segmenter=who), net)

    asked = {str(who): asking(who) for who in SEGMENTERS}
    if pair is not None:
        asked[PAIR] = lambda _: pair()
    seconds: dict[str, list[float]] = {name: [] for name in asked}
    made = pictures(trees)
    for turn in range(repeats + 1):
        for picture in made if turn else made[:1]:
            for name, work in asked.items():
                start = time.perf_counter()
                work(picture)
                if turn:
                    seconds[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in seconds.items()}


def table(seconds: Mapping[str, float]) -> str:
    """Markdown: a line per method; the pair and the ratio to it where it was timed."""
    pair = seconds.get(PAIR)
    columns = ["segmenter", "s per 512 x 512 picture", *([f"{PAIR} s", "pairs"] if pair else [])]
    out = ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    for name, value in seconds.items():
        if name != PAIR:
            beside = [f"{pair:.3f}", f"{value / pair:.1f}"] if pair else []
            out.append("| " + " | ".join([name, f"{value:.3f}", *beside]) + " |")
    return "\n".join(out)
