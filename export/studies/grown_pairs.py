"""Pairs of grown trees before another chest, from any C-arm: paths, masks and raw pictures.

    python -m gcar_export.studies.grown_pairs

Trees, cameras and pictures of other making than those that networks and options were chosen on
(``scenes/grown_trees.py``, ``scenes/thorax.py``): pictures of 512 to 1024 pixels over 120 to 190
mm, turned detectors, views 40 to 125 degrees apart; six of ten raw pairs have a catheter. A point
of a line is found where the other passes within ``NEAR_MM``; what a view does not see is not asked.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from gcar_deploy.engine import Engine
from gcar_deploy.geometry.carm import CArm, separation_deg
from gcar_deploy.geometry.default_grid import default_grid
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.types import Image, Points
from gcar_export.scenes.grown_trees import grown_tree
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.thorax import exposure
from gcar_export.scenes.trees import SyntheticTree
from gcar_export.studies.command import arguments, ended, print_table
from gcar_export.studies.pair_rows import Judged, judge, table_by_name

SEED, NEAR_MM = 28_111, 1.5
KINDS = "path_length", "mask", "raw"
#: a mask shows what is thicker than this, mm
_LEAST_MM = 0.25
#: angles between two views, deg, and share of raw pairs with a catheter
_BETWEEN_DEG, _WITH_CATHETER = (40.0, 125.0), 0.6


def carms(rng: np.random.Generator) -> list[CArm]:
    """Draw two views of any clinical C-arm."""
    out: list[CArm] = []
    while len(out) < 2:
        side = int(rng.choice([512, 512, 768, 1024]))
        sod, sdd, field = rng.uniform(690, 810), rng.uniform(980, 1200), rng.uniform(120, 190)
        pitch = field * sdd / sod / side
        own = CArm(
            primary_angle_deg=rng.uniform(-95, 95), secondary_angle_deg=rng.uniform(-38, 38),
            sod_mm=sod, sdd_mm=sdd, rows=side, columns=side, pixel_spacing_mm=(pitch, pitch),
            detector_rotation_deg=float(rng.choice([0, 0, rng.uniform(-15, 15)])),
        )  # fmt: skip
        least, most = _BETWEEN_DEG
        if all(least < separation_deg(own, other) < most for other in out):
            out.append(own)
    return out


def catheter(tree: SyntheticTree, rng: np.random.Generator) -> tuple[Points, float]:
    """(n, 3) points of a catheter from far above into the inlet, and its radius, mm."""
    end = tree.vessels[0].points_mm[0]
    bend = end + rng.uniform([-12, -5, 10], [12, 15, 25])
    far = end + rng.uniform([-25, 5, 60], [25, 40, 90])
    t = np.linspace(0, 1, 160)[:, None]
    return (1 - t) ** 2 * end + 2 * t * (1 - t) * bend + t**2 * far, rng.uniform(0.75, 1.1)


def pair(seed: int, number: int, kind: str) -> tuple[list[Angiogram], Points]:
    """Return two pictures of a grown tree, and the points of its line that both see, mm."""
    rng = np.random.default_rng([seed, number])
    tree, views = grown_tree(rng), carms(rng)
    line = tree.line()
    for carm in views:
        pixels = carm.project(line)[0]
        line = line[((pixels > 0) & (pixels < [carm.columns - 1, carm.rows - 1])).all(axis=1)]
    device = catheter(tree, rng) if rng.random() < _WITH_CATHETER else None
    out = []
    for k, carm in enumerate(views):
        path = path_lengths(carm, *tree.segments())
        scale = 1.0 if kind == "path_length" else None
        out.append(
            Angiogram(
                view_id=str(k + 1), carm=carm, pixels=_picture(kind, carm, path, device, rng),
                bit_depth=8, sha256=f"{number}-{k}",
                intensity=Intensity(kind=kind, mm_per_count=scale),
            )
        )  # fmt: skip
    return out, line


def _picture(
    kind: str, carm: CArm, path: Image, device: tuple[Points, float] | None,
    rng: np.random.Generator,
) -> Image:  # fmt: skip
    if kind == "path_length":
        return path
    if kind == "mask":
        return (path > _LEAST_MM).astype(np.float32)
    within = None
    if device is not None:
        points, radius = device
        within = path_lengths(carm, points[:-1], points[1:], np.full(len(points) - 1, radius))
    return exposure(path, within, carm.pixel_at_isocenter_mm, rng)


def judged(seed: int, pairs: int) -> Iterator[tuple[str, *Judged]]:
    """Yield the kind, share of the true line found, share of ours that is true, and status."""
    engine = Engine()
    for number in range(pairs):
        for kind in KINDS:
            views, line = pair(seed, number, kind)
            grid = default_grid([view.carm for view in views])
            yield kind, *judge(engine, views, grid, line, NEAR_MM)


def table(rows: Sequence[tuple[str, *Judged]]) -> str:
    """Markdown: one line a kind of picture."""
    return table_by_name(rows, "pictures", NEAR_MM)


def main() -> None:
    """Print the table."""
    asked = arguments(__doc__, "--pairs", 40, SEED).parse_args()
    print_table(judged(asked.seed, asked.pairs), len(KINDS) * asked.pairs, table)


if __name__ == "__main__":
    raise SystemExit(ended(main))
