"""Refinement from true points, with and without noise, on real trees: volume DSC and seconds.

DIR holds ``imagecas/*.label.nii.gz``. Starting points are the centres of the truth's voxels
(any occupancy above 0, the occupancy as confidence); with noise each point is moved by its own
Gaussian offset (standard deviation per axis, in voxels) and 10 % of them are dropped. Volume DSC
at 0.5, as everywhere.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from gcar_deploy.config import RefineOptions, RunOptions
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.refine.refine import refine, refined_volume
from gcar_deploy.tree.occupancy import tree_occupancy
from gcar_deploy.types import Volume
from gcar_export.evaluate import case_name, find_labels
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


#: rows of the table: refiner, and whether the loss has its centreline part
MODES = (("tube", False), ("tube", True), ("paper", False), ("paper", True))


def mode_options(refiner: str, centreline: bool) -> RefineOptions:
    """Options of one row; the paper's loss is half centreline where it has that part."""
    options = RefineOptions(refiner=refiner)
    share = 1.0 - options.paper.alpha if centreline else 0.0
    return dataclasses.replace(
        options,
        tube=dataclasses.replace(options.tube, centreline_share=share),
        paper=dataclasses.replace(options.paper, alpha=1.0 - share),
    )


def refine_rows(
    data: Path,
    protocol: str,
    cases: Sequence[str],
    noises: Sequence[float],
    on_fit: Callable[[], None] | None = None,
) -> dict[tuple[str, bool], list[list[Row]]]:
    """Fit every case from every start in every mode: mode -> per case, per noise, a row."""
    found: dict[tuple[str, bool], list[list[Row]]] = {mode: [] for mode in MODES}
    for path in labels_of(data, cases):
        case = make_case(read_label(path), protocol)
        views = [extract_vessels(a, RunOptions().imaging) for a in case.angiograms()]
        for mode in MODES:
            rows = []
            for noise in noises:
                rows.append(one_fit(case.truth, case.grid, views, noise, mode_options(*mode)))
                if on_fit is not None:
                    on_fit()
            found[mode].append(rows)
    return found


def labels_of(data: Path, cases: Sequence[str]) -> list[Path]:
    """Label volumes of the wanted cases, all where none are named."""
    wanted = [p for p in find_labels(data) if not cases or case_name(p) in cases]
    return wanted


def table(found: dict[tuple[str, bool], list[list[Row]]], noises: Sequence[float]) -> str:
    """Markdown: mean volume DSC and CPU seconds of fit and volume, per mode and start noise."""
    head = " | ".join(f"{noise:g} voxels" for noise in noises)
    lines = [
        f"| refiner | centreline loss | {head} | CPU s |",
        "|---|---|" + "---|" * len(noises) + "---|",
    ]
    for (refiner, centreline), rows in found.items():
        dice_ = np.array([[row.dice for row in case] for case in rows])
        seconds = np.mean([[row.fit_s + row.volume_s for row in case] for case in rows])
        cells = " | ".join(f"{100 * value:.1f}" for value in dice_.mean(axis=0))
        with_ = "with" if centreline else "without"
        lines.append(f"| {refiner} | {with_} | {cells} | {seconds:.2f} |")
    return "\n".join(lines)
