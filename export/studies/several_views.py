"""Three and four masks or raw pictures, as told and of a patient who moved, and one of a stranger.

    python -m gcar_export.studies.several_views

Generated trees of three styles, clinical views turned by some degrees. Masks lack a part of the
thin vessels and have bites; raw pictures are those of ``hard_raw``. A patient who moved did so
before every view but the first, and the angles are read a little wrongly. How far the views stand
from each other is told by the rays of points of the true tree: RMS of what they miss each other by.
The true line is where the views see it as they were found; a point of it is found where ours passes
within ``NEAR_MM``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence

import click
import cv2
import numpy as np

from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import triangulate
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.prior import ANGLE_DEG, OFFSET_MM
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.tree.curves import resample
from gcar_deploy.types import Image
from gcar_export.scenes.protocols import clinical_geometry
from gcar_export.scenes.raw_pictures import random_options, raw_picture
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.trees import SyntheticTree, any_style, random_tree
from gcar_export.studies.pair_rows import Judged, head, row, shares
from gcar_export.studies.wrong_scenes import SIDES

SEED = 28_110
NEAR_MM = 1.5
#: standard deviation of each angle of a view, deg
SPREAD_DEG = 12.0
#: a mask shows what is thicker than this, mm, and has so many bites of up to this radius, mm
LEAST_MM, MOST_BITES, BITE_MM = (0.15, 0.6), 8, 2.5
TOLD, MOVED, STRANGER = "as told", "moved", "last view of another patient"
#: status, shares, and how far the true rays miss each other as told and as found, mm
Row = tuple[str, Judged, float, float]


def mask(path: Image, pixel_mm: float, rng: np.random.Generator) -> Image:
    """(rows, cols) float32, 0 or 1: what a segmentation may leave of path lengths, mm."""
    seen = (path > rng.uniform(*LEAST_MM)).astype(np.uint8)
    for row_, col in rng.permutation(np.argwhere(seen))[: rng.integers(MOST_BITES + 1)].tolist():
        cv2.circle(seen, (col, row_), int(rng.uniform(0.5, BITE_MM) / pixel_mm), 0, -1)
    return seen.astype(np.float32)


def scene(
    seed: int, number: int, kind: str, asked: str
) -> tuple[list[Angiogram], list[CArm], SyntheticTree, Grid]:
    """Return pictures with the C-arms that are told, those that saw them, tree and grid."""
    rng = np.random.default_rng([seed, number])
    tree, other = (random_tree(rng, any_style(rng)).sides(SIDES[number % 2]) for _ in range(2))
    carms, _, grid = clinical_geometry(3 + number // 2 % 2)
    told = [carm.turned(*(SPREAD_DEG * rng.normal(size=2))) for carm in carms]
    options, seen, pictures = random_options(rng), [], []
    for k, carm in enumerate(told):
        (first, second), shift = ANGLE_DEG * rng.normal(size=2), OFFSET_MM * rng.normal(size=3)
        seen.append(carm.turned(first, second, shift) if k and asked == MOVED else carm)
        shown = other if asked == STRANGER and k == len(told) - 1 else tree
        path = path_lengths(seen[-1], *shown.segments())
        pictures.append(
            Angiogram(
                view_id=str(k + 1), carm=carm, bit_depth=8, intensity=Intensity(kind=kind),
                pixels=mask(path, carm.pixel_at_isocenter_mm, rng) if kind == "mask"
                else raw_picture(path, rng, options).astype("f4"), sha256=f"{number}-{k}",
            )
        )  # fmt: skip
    return pictures, seen, tree, grid


def judged(seed: int, count: int) -> Iterator[Row]:
    """Yield a row for each scene of each kind."""
    engine = Engine()
    for kind in ("mask", "raw"):
        for asked in (TOLD, MOVED, STRANGER):
            for number in range(count):
                pictures, seen, tree, grid = scene(seed, number, kind, asked)
                line = np.concatenate([resample(v.points_mm, 0.5) for v in tree.vessels])
                pixels = [carm.project(line)[0] for carm in seen]

                def apart(carms: Sequence[CArm], pixels: list[np.ndarray] = pixels) -> float:
                    return float(np.sqrt(np.mean(triangulate(carms, pixels)[1] ** 2)))

                told = [picture.carm for picture in pictures]
                try:
                    found = engine.reconstruct(pictures, grid)
                except GcarError:
                    yield f"{kind}, {asked}", (0.0, 0.0, "refused"), apart(told), np.nan
                    continue
                placed = [p.applied(c) for p, c in zip(found.poses, told, strict=True)]
                # Nobody can say which view stands as told: the line is where the views see it.
                there, _ = triangulate(placed, pixels)
                ours = *shares(found.tree.points(), there, NEAR_MM), found.status
                yield f"{kind}, {asked}", ours, apart(told), apart(placed)


def table(rows: Sequence[Row]) -> str:
    """Markdown: a line per kind of scene, and how far the views stand from each other."""
    out = [head("views", NEAR_MM).replace("pairs", "scenes")]
    names = dict.fromkeys(name for name, *_ in rows)
    for name in names:
        own = [one for label, one, *_ in rows if label == name]
        out.append(row(name, own, known=STRANGER not in name))
    out += ["", "| views | rays miss each other as told mm | as found mm (of those not refused) |"]
    out.append("|---|---|---|")
    for name in names:
        apart = np.array([pair for label, _, *pair in rows if label == name])
        apart = apart[np.isfinite(apart[:, 1])]
        if STRANGER not in name and len(apart):
            before, after = apart.mean(axis=0)
            out.append(f"| {name} | {before:.2f} | {after:.2f} |")
    return "\n".join(out)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=12)
    parser.add_argument("--seed", type=int, default=SEED)
    asked = parser.parse_args()
    found = judged(asked.seed, asked.scenes)
    with click.progressbar(found, length=6 * asked.scenes, file=sys.stderr) as bar:
        print(table(list(bar)))


if __name__ == "__main__":
    main()
