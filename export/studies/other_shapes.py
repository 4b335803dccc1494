"""Shapes that are no coronary tree, seen by C-arms of five makes.

    python -m gcar_export.studies.other_shapes

Each shape (``gcar_export.scenes.shapes``) is drawn anew for each C-arm and given as exact path
lengths, as masks, dark on white, and as raw pictures with anatomy and noise. A point is found where
the other line passes within ``NEAR_MM``. Where two views leave open which of two lines is which, a
tree may be wrong, but ``ok`` should not stand beside it: the last column of the tables.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from gcar_deploy.engine import Engine
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.tree.curves import resample
from gcar_deploy.types import Image, Points
from gcar_export.scenes.protocols import MASK_PATH_MM
from gcar_export.scenes.raw_pictures import random_options, raw_picture
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.shapes import SHAPES, shape
from gcar_export.studies.command import arguments, ended, print_table
from gcar_export.studies.pair_rows import Judged, head, judge, row

SEED = 5
NEAR_MM = 1.5
GRID = Grid(center_mm=(0, 0, 0), size_mm=(130,) * 3, shape=(130,) * 3)
KINDS = ("exact", "mask", "dark on white", "raw")
#: SOD mm, SDD mm, pixels, rows' and columns' pitch mm, two pairs of angles
CARMS = (
    (750, 1100, 512, (0.3, 0.3), ((-30, 20), (45, -25))),
    (900, 1200, 256, (0.7, 0.7), ((0, 0), (90, 0))),
    (600, 1000, 768, (0.25, 0.25), ((-20, -20), (20, 30))),
    (765, 990, 400, (0.5, 0.4), ((40, 20), (-50, 5))),
    (1000, 1500, 1024, (0.2, 0.2), ((10, 30), (100, -20))),
)


@dataclasses.dataclass(frozen=True, eq=False)
class ShapeScene:
    """A shape's name, the views, path lengths (mm) per view, and points of the true line."""

    name: str
    carms: list[CArm]
    paths: list[Image]
    line_mm: Points


def scene(seed: int, number: int) -> ShapeScene:
    """Draw scene ``number``: shapes in turn, C-arms in turn, every pair of both in 65."""
    names = list(SHAPES)
    name = names[number % len(names)]
    sod, sdd, pixels, pitch, angles = CARMS[(number // len(names) + number) % len(CARMS)]
    lumen, lines = shape(name, np.random.default_rng([seed, number]))
    carms = [
        CArm(
            primary_angle_deg=a, secondary_angle_deg=b, sod_mm=sod, sdd_mm=sdd, rows=pixels,
            columns=pixels, pixel_spacing_mm=pitch,
        )
        for a, b in angles
    ]  # fmt: skip
    paths = [path_lengths(carm, lumen.starts, lumen.ends, lumen.radii) for carm in carms]
    return ShapeScene(name, carms, paths, np.concatenate([resample(x, 0.5) for x in lines]))


def pictures(of: ShapeScene, kind: str, seed: int, number: int) -> list[Angiogram]:
    """Return the pictures of a scene, as one of ``KINDS``."""
    rng = np.random.default_rng([seed, number, KINDS.index(kind)])
    options = random_options(rng)
    out = []
    for k, (carm, path) in enumerate(zip(of.carms, of.paths, strict=True)):
        told, pixels = Intensity(kind="raw"), path
        if kind == "exact":
            told = Intensity(kind="path_length", mm_per_count=1.0)
        elif kind == "mask":
            told, pixels = Intensity(kind="mask"), 255.0 * (path > MASK_PATH_MM)
        elif kind == "dark on white":
            pixels = np.rint(250 * np.exp(-0.3 * path))
        else:
            pixels = raw_picture(path, rng, options).astype(np.float32)
        out.append(
            Angiogram(
                view_id=str(k + 1), carm=carm, intensity=told, pixels=pixels.astype(np.float32),
                bit_depth=16 if kind == "exact" else 8, sha256=f"{number}-{kind}-{k}",
            )
        )  # fmt: skip
    return out


def judged(
    seed: int, numbers: Sequence[int], kinds: Sequence[str], engine: Engine
) -> Iterator[tuple[str, str, *Judged]]:
    """Yield kind, shape, share of the true line found, of ours that is true, and status."""
    for number in numbers:
        of = scene(seed, number)
        for kind in kinds:
            views = pictures(of, kind, seed, number)
            yield kind, of.name, *judge(engine, views, GRID, of.line_mm, NEAR_MM)


def table(rows: Sequence[tuple[str, str, *Judged]]) -> str:
    """Markdown: a line per kind of picture, then one per shape."""
    out = []
    for column, title in enumerate(("pictures", "shape")):
        out.append(head(title, NEAR_MM))
        for name in dict.fromkeys(str(own[column]) for own in rows):
            out.append(row(name, [own[2:] for own in rows if own[column] == name]))
        out.append("")
    return "\n".join(out)


def main() -> None:
    """Print the tables."""
    parser = arguments(__doc__, "--scenes", len(SHAPES) * len(CARMS), SEED)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--model", default=None)
    asked = parser.parse_args()
    kinds = asked.kinds.split(",")
    found = judged(asked.seed, range(asked.scenes), kinds, Engine(asked.model))
    print_table(found, asked.scenes * len(kinds), table)


if __name__ == "__main__":
    raise SystemExit(ended(main))
