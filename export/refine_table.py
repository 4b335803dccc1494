"""Refinement from true points, with and without noise, on real trees: volume DSC and seconds.

    python -m gcar_export.refine_table --data DIR [--cases 0001,0003] [--protocols paper,clinical]

DIR holds ``imagecas/*.label.nii.gz``. Starting points are the centres of the truth's voxels
(any occupancy above 0, the occupancy as confidence); with noise each point is moved by its own
Gaussian offset (standard deviation per axis, in voxels) and 10 % of them are dropped. Volume DSC
at 0.5, as everywhere.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import click
import numpy as np

from gcar_deploy.config import RefineOptions, RunOptions
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.refine.refine import refine, refined_volume
from gcar_deploy.tree.occupancy import tree_occupancy
from gcar_deploy.types import Volume
from gcar_export.labels import read_label
from gcar_export.protocols import make_case

NOISES = (0.0, 0.5, 1.0, 2.0)
DROPPED = 0.1


def start_points(truth: Volume, grid: Grid, noise_voxels: float, seed: int) -> CenterPoints:
    """Centres of occupied voxels; with noise, moved and one in ten dropped."""
    index = np.argwhere(truth > 0)
    confidence = truth[truth > 0].astype(np.float64)
    points = grid.index2world(index)
    h = float(grid.spacing_mm[0])
    rng = np.random.default_rng(seed)
    if noise_voxels > 0:
        points = points + rng.normal(0.0, noise_voxels * h, points.shape)
        keep = rng.random(len(points)) >= DROPPED
        points, confidence = points[keep], confidence[keep]
    return CenterPoints(
        points_mm=points,
        confidence=confidence,
        radius_mm=np.full(len(points), np.nan),
        spacing_mm=h,
        source="multi",
    )


def dice(truth: Volume, volume: Volume) -> float:
    """Volume DSC at 0.5."""
    a, b = truth >= 0.5, volume >= 0.5
    return float(2 * np.count_nonzero(a & b) / max(np.count_nonzero(a) + np.count_nonzero(b), 1))


@dataclasses.dataclass(frozen=True)
class Row:
    """One fit: DSC of the final volume and of the bare tubes, CPU seconds of both stages."""

    dice: float
    tube_dice: float
    fit_s: float
    volume_s: float


def one_fit(
    truth: Volume, grid: Grid, views: list[VesselImage], noise: float, options: RefineOptions
) -> Row:
    """Refine one start and score it; seconds are process CPU seconds."""
    centers = start_points(truth, grid, noise, seed=0)
    begin = time.process_time()
    refined = refine(centers, views, options)
    middle = time.process_time()
    volume = refined_volume(refined, views, grid, options)
    end = time.process_time()
    bare = tree_occupancy(refined.tree, grid) if refined.tree is not None else volume
    return Row(dice(truth, volume), dice(truth, bare), middle - begin, end - middle)


@click.command()
@click.option("--data", type=click.Path(exists=True, path_type=Path), required=True)
@click.option("--cases", default="", help="comma-separated case names; all where absent")
@click.option("--protocols", default="paper,clinical", show_default=True)
@click.option("--noises", default="0,0.5,1,2", show_default=True, help="voxels")
@click.option("--refiner", default="tube", show_default=True)
def main(data: Path, cases: str, protocols: str, noises: str, refiner: str) -> None:
    """Print the table."""
    levels = [float(x) for x in noises.split(",")]
    options = RefineOptions(refiner=refiner)
    wanted = {name for name in cases.split(",") if name}
    files = sorted((data / "imagecas").glob("*.label.nii.gz"))
    files = [f for f in files if not wanted or f.name.split(".")[0] in wanted]
    for protocol in protocols.split(","):
        click.echo(
            f"{protocol}: DSC of volume (bare tubes) and CPU s (fit + volume) per start noise"
        )
        click.echo("case   " + "".join(f"{f'{n:g} voxels':>30}" for n in levels))
        rows: list[list[Row]] = []
        for file in files:
            case = make_case(read_label(file), protocol)
            images = [extract_vessels(a, RunOptions().imaging) for a in case.angiograms()]
            rows.append([one_fit(case.truth, case.grid, images, n, options) for n in levels])
            click.echo(f"{file.name.split('.')[0]:7}" + "".join(_cell(r) for r in rows[-1]))
        means = [
            Row(*np.mean([dataclasses.astuple(line[k]) for line in rows], axis=0).tolist())
            for k in range(len(levels))
        ]
        click.echo(f"{'mean':7}" + "".join(_cell(r) for r in means))


def _cell(row: Row) -> str:
    return f"{f'{row.dice:.3f} ({row.tube_dice:.3f}) {row.fit_s:.2f}+{row.volume_s:.2f} s':>30}"


if __name__ == "__main__":
    main()
