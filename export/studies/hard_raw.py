"""Trees from raw pairs of every contrast, display and background, and from pairs of two patients.

    python -m gcar_export.studies.hard_raw

Generated trees of three styles (as in training, thin, rough) and two clinical views turned by some
degrees; the pictures' contrast, anatomy, noise, blur, display curve and window vary far. The same
first views with the second of another patient must not be ``ok``. A point is found where the other
line passes within ``NEAR_MM``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from gcar_deploy.engine import Engine
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.types import Points
from gcar_export.scenes.protocols import clinical_geometry
from gcar_export.scenes.raw_pictures import random_options, raw_picture
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.trees import any_style, random_tree
from gcar_export.studies.command import arguments, ended, print_table
from gcar_export.studies.pair_rows import Judged, judge, table_by_name
from gcar_export.studies.wrong_scenes import SIDES

SEED = 81_030
NEAR_MM = 1.5
#: standard deviation of each angle of a view, deg
SPREAD_DEG = 12.0
#: tree ``k + OTHER`` is the other patient; as many apart as to be of the same side
OTHER = 1000
ONE, TWO = "one patient", "two patients"


@dataclasses.dataclass(frozen=True, eq=False)
class RawPair:
    """Two raw pictures of one generated tree; its centreline points in mm, (n, 3)."""

    angiograms: tuple[Angiogram, Angiogram]
    grid: Grid
    line_mm: Points


def raw_pair(seed: int, number: int) -> RawPair:
    """Simulate the examination of tree ``number``: even ones are left, odd ones right."""
    rng = np.random.default_rng([seed, number])
    tree = random_tree(rng, any_style(rng)).sides(SIDES[number % 2])
    carms, _, grid = clinical_geometry(2)
    turned = [carm.turned(*(SPREAD_DEG * rng.normal(size=2))) for carm in carms]
    options = random_options(rng)
    one, two = (
        Angiogram(
            view_id=str(k + 1), carm=carm, bit_depth=8, intensity=Intensity(kind="raw"),
            pixels=raw_picture(path_lengths(carm, *tree.segments()), rng, options).astype("f4"),
            sha256=f"{number}-{k}",
        )
        for k, carm in enumerate(turned)
    )  # fmt: skip
    return RawPair((one, two), grid, tree.line())


def judged(seed: int, pairs: int) -> Iterator[tuple[str, *Judged]]:
    """Yield which pair, share of the true line found, share of ours that is true, and status."""
    engine = Engine()
    for number in range(pairs):
        pair = raw_pair(seed, number)
        stranger = raw_pair(seed, number + OTHER).angiograms[1]
        asked = ((ONE, pair.angiograms[1]), (TWO, stranger))
        for name, second in asked:
            views = [pair.angiograms[0], second]
            yield name, *judge(engine, views, pair.grid, pair.line_mm, NEAR_MM)


def table(rows: Sequence[tuple[str, *Judged]]) -> str:
    """Markdown: one line per kind of pair."""
    return table_by_name(rows, "pictures of", NEAR_MM, unknown=(TWO,))


def main() -> None:
    """Print the table."""
    asked = arguments(__doc__, "--pairs", 30, SEED).parse_args()
    print_table(judged(asked.seed, asked.pairs), 2 * asked.pairs, table)


if __name__ == "__main__":
    raise SystemExit(ended(main))
