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

import itertools
from collections.abc import Iterator, Sequence

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
from gcar_deploy.types import Image, Pixels, Points
from gcar_export.scenes.protocols import clinical_geometry
from gcar_export.scenes.raw_pictures import random_options, raw_picture
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.trees import SyntheticTree, any_style, random_tree
from gcar_export.studies.command import arguments, ended, print_table
from gcar_export.studies.hard_raw import NEAR_MM, SPREAD_DEG
from gcar_export.studies.pair_rows import Judged, head, row, shares
from gcar_export.studies.wrong_scenes import SIDES

SEED = 28_110
#: a mask shows what is thicker than this, mm, and has so many bites of up to this radius, mm
LEAST_MM, MOST_BITES, BITE_MM = (0.15, 0.6), 8, 2.5
KINDS = "mask", "raw"
TOLD, MOVED, STRANGER = ASKED = "as told", "moved", "last view of another patient"
#: name of the row, what came out, how far true rays miss each other as told and as found, mm
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


def where(carms: Sequence[CArm], pixels: Sequence[Pixels]) -> tuple[Points, float]:
    """(n, 3) where views see points, mm, and how far the rays miss them, RMS over all, mm."""
    points, apart = triangulate(carms, pixels)
    return points, float(np.sqrt(np.mean(apart**2)))


def judged(seed: int, count: int) -> Iterator[Row]:
    """Yield a row for each scene of each kind."""
    engine = Engine()
    for kind, asked, number in itertools.product(KINDS, ASKED, range(count)):
        pictures, seen, tree, grid = scene(seed, number, kind, asked)
        pixels = [carm.project(tree.line())[0] for carm in seen]
        told = [picture.carm for picture in pictures]
        _, before = where(told, pixels)
        try:
            found = engine.reconstruct(pictures, grid)
        except GcarError:
            yield f"{kind}, {asked}", (0.0, 0.0, "refused"), before, np.nan
            continue
        placed = [p.applied(c) for p, c in zip(found.poses, told, strict=True)]
        # Nobody can say which view stands as told: the line is where the views see it.
        there, after = where(placed, pixels)
        ours = *shares(found.tree.points(), there, NEAR_MM), found.status
        yield f"{kind}, {asked}", ours, before, after


def table(rows: Sequence[Row]) -> str:
    """Markdown: a line per kind of scene, and how far the views stand from each other."""
    out = [head("views", NEAR_MM, "scenes")]
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
    asked = arguments(__doc__, "--scenes", 12, SEED).parse_args()
    count = len(KINDS) * len(ASKED) * asked.scenes
    print_table(judged(asked.seed, asked.scenes), count, table)


if __name__ == "__main__":
    raise SystemExit(ended(main))
