"""What the workshop offers to ``gcar bench``: label volumes as cases, and the itk-rtk pair."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from gcar_deploy.bench.tradeoff import BenchCase
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.measure.metrics import VOLUME_THRESHOLD, skeleton
from gcar_deploy.types import Volume
from gcar_export.methods.rtk_timing import pair_carms, pair_clock
from gcar_export.scenes.labels import read_label
from gcar_export.scenes.protocols import Case, make_case

#: set-up of the simulated views
PROTOCOL = "clinical"


def label_cases(folder: Path) -> list[BenchCase]:
    """Simulate the clinical views of every label volume below a folder.

    Raises
    ------
    UsageError
        If there are none.
    """
    from gcar_export.evaluate.evaluate import find_labels

    return [bench_case(make_case(read_label(path), PROTOCOL)) for path in find_labels(folder)]


def bench_case(case: Case) -> BenchCase:
    """Return a simulated case as the benchmark wants it; its centreline is the thinned truth."""
    line = skeleton(case.truth >= VOLUME_THRESHOLD, case.grid.spacing_mm)
    return BenchCase(
        name=case.name,
        angiograms=tuple(case.angiograms()),
        grid=case.grid,
        truth=case.truth,
        centreline_mm=case.grid.index2world(line.index.astype(np.float64)),
    )


def pair_timer(volume: Volume, grid: Grid) -> Callable[[], float]:
    """Return what runs one itk-rtk forward + back projection and says how long it took, s.

    128^3 voxels and two 128x128 views, whatever the case: the unit stays the same.

    Raises
    ------
    ImportError
        itk-rtk is not installed.
    """
    side = 128
    small = np.zeros((side, side, side), np.float32)
    low = [(side - n) // 2 for n in volume.shape]
    if min(low) >= 0:
        small[tuple(slice(a, a + n) for a, n in zip(low, volume.shape, strict=True))] = volume
    cube = Grid(center_mm=(0, 0, 0), size_mm=(180.0,) * 3, shape=(side,) * 3)
    return pair_clock(small, cube, pair_carms())
