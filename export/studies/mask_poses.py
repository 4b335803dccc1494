"""What poses of mask pairs come out as: ``python -m gcar_export.studies.mask_poses``.

Generated trees, left and right, as masks of two clinical views, as placed and with the patient
moved before the second view: how many pairs are corrected, and how far apart the rays of the true
centreline pass afterwards, which is the part of an error of the pose that two views can see.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np

from gcar_deploy.config import PoseOptions
from gcar_deploy.geometry.epipolar import ray_gaps
from gcar_deploy.imaging.mask_path import mask_path
from gcar_deploy.pose.pairwise import estimate_poses
from gcar_export.scenes.gantry import clinical_views
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.trees import SIDES, random_tree, rough_style, thin_style
from gcar_export.studies.command import ended

SEED = 74_001
#: standard deviation of the patient's shift along each axis, mm, and pixel of the masks
SHIFTS_MM, PIXEL_MM = (0.0, 1.0, 2.0, 4.0), 0.9


def judged(trees: int) -> Iterator[tuple[float, bool, float, float]]:
    """Yield shift, whether a correction was made, and gaps of the rays before and after, mm."""
    for number in range(trees):
        rng = np.random.default_rng([SEED, number])
        style = (None, rough_style(rng), thin_style(rng))[rng.choice(3, p=[0.45, 0.45, 0.1])]
        tree = random_tree(rng, style).sides(SIDES[number % 2]).segments()
        first, told = clinical_views(rng, 2, PIXEL_MM)
        way = rng.normal(size=3)
        for shift in SHIFTS_MM:
            true = told.moved(shift * way)
            masks = [
                (carm, mask_path(path_lengths(drawn, *tree) > 0, carm.pixel_at_isocenter_mm))
                for carm, drawn in ((first, first), (told, true))
            ]
            pose = estimate_poses(masks, PoseOptions(), masks=(True, True))[1]
            seen = first.project(tree[0])[0], true.project(tree[0])[0]
            gaps = [
                float(np.sqrt(np.mean(ray_gaps(first, carm, *seen) ** 2)))
                for carm in (told, pose.applied(told))
            ]
            yield shift, bool(pose.theta.any()), gaps[0], gaps[1]


def table(rows: list[tuple[float, bool, float, float]]) -> str:
    """Markdown: pairs that are corrected, and gaps of the rays."""
    out = [
        "| shift mm (SD an axis) | pairs | corrected | gap as told mm | after mm, mean (largest) |",
        "|---" * 5 + "|",
    ]
    for shift in SHIFTS_MM:
        own = np.array([row for row in rows if row[0] == shift])
        out.append(
            f"| {shift:g} | {len(own)} | {int(own[:, 1].sum())} | {own[:, 2].mean():.2f} | "
            f"{own[:, 3].mean():.2f} ({own[:, 3].max():.2f}) |"
        )
    return "\n".join(out)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trees", type=int, default=40)
    print(table(list(judged(parser.parse_args().trees))))


if __name__ == "__main__":
    raise SystemExit(ended(main))
