"""What the lines of ``quality.scale`` cost and find: ``python -m gcar_export.studies.scale_lines``.

True generated trees, left and right, in exact path lengths of the clinical views, as they are and
blurred by up to a pixel (the standard deviation of a Gaussian): the mean factor of both views, and
the share that is doubted where it is right, and where ``mm_per_count`` is off by a tenth.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np
from scipy.ndimage import gaussian_filter

from gcar_deploy.config import RunOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.quality.scale import check_scale, mean_factor, scale_factor
from gcar_deploy.types import Image
from gcar_export.scenes.protocols import MM_PER_COUNT, clinical_geometry
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.stenosis_cases import Tube
from gcar_export.scenes.trees import SIDES, random_tree, rough_style, thin_style
from gcar_export.scenes.true_trees import joined_tree
from gcar_export.studies.command import ended

SEED = 73_001
BLURS_PX = (0.0, 0.5, 1.0)
FACTORS = (1.0, 1 / 1.1, 1.1)


def view_of(carm: CArm, path_mm: Image, factor: float) -> VesselImage:
    """Read a picture whose ``mm_per_count`` is off by a factor."""
    counts = np.rint(path_mm / MM_PER_COUNT).astype(np.float32)
    intensity = Intensity(
        kind="path_length", polarity="bright", mm_per_count=factor * MM_PER_COUNT
    )  # fmt: skip
    angiogram = Angiogram(
        view_id="1", carm=carm, pixels=counts, bit_depth=16, intensity=intensity, sha256=""
    )
    return extract_vessels(angiogram, RunOptions().imaging)


def judged(trees: int) -> Iterator[tuple[float, float, float | None, bool]]:
    """Yield blur in pixels, factor told, mean factor found, and whether it is doubted."""
    for number in range(trees):
        rng = np.random.default_rng([SEED, number])
        style = (None, rough_style(rng), thin_style(rng))[rng.choice(3, p=[0.45, 0.45, 0.1])]
        truth = random_tree(rng, style).sides(SIDES[number % 2])
        tree = joined_tree([Tube(v.name, v.points_mm, v.radius_mm) for v in truth.vessels])
        carms = clinical_geometry(2)[0]
        paths = [path_lengths(carm, *truth.segments()) for carm in carms]
        for blur in BLURS_PX:
            blurred = [gaussian_filter(path, blur) if blur else path for path in paths]
            for factor in FACTORS:
                views = [view_of(c, path, factor) for c, path in zip(carms, blurred, strict=True)]
                found = mean_factor(views, [scale_factor(tree, view) for view in views])
                yield blur, factor, found, bool(check_scale(tree, views))


def table(rows: list[tuple[float, float, float | None, bool]]) -> str:
    """Markdown: factors of right pictures, and what is doubted."""
    out = [
        "| blur, pixels | trees | told | mean factor: least, 5 %, median, 95 %, most | doubted % |",
        "|---" * 5 + "|",
    ]
    for blur in BLURS_PX:
        for factor in FACTORS:
            own = [row for row in rows if row[:2] == (blur, factor)]
            found = [row[2] for row in own if row[2] is not None]
            spread = ", ".join(f"{v:.3f}" for v in np.percentile(found, [0, 5, 50, 95, 100]))
            doubted = 100 * np.mean([row[3] for row in own])
            out.append(f"| {blur:g} | {len(own)} | {factor:.2f} | {spread} | {doubted:.0f} |")
    return "\n".join(out)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trees", type=int, default=24)
    print(table(list(judged(parser.parse_args().trees))))


if __name__ == "__main__":
    raise SystemExit(ended(main))
