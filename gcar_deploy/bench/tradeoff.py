"""Speed against error: a grid over iterations, Gaussians, resolution, refiner and predictor.

Every cell reconstructs the same case from pictures in memory, warm, several times. The error is
that of the centreline against the truth; beside it stands the Cramer-Rao bound of a point seen
with ``NOISE_PX`` of noise in the finest pictures, below which no work can bring a single point.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.config import PredictorName, RefinerName, RunOptions
from gcar_deploy.data.demo_case import demo_case
from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError, UsageError
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.observability import point_sigmas
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.imaging.resample import area_average
from gcar_deploy.inputs.pictures import prepare
from gcar_deploy.measure.metrics import volume_dice
from gcar_deploy.tree.curves import points_every
from gcar_deploy.types import Points, Volume

#: noise of a vessel's position in the finest picture for the bound, pixels
NOISE_PX = 0.5
#: the knee: the cheapest cell on the front whose error is within this factor of the least
GOOD_ENOUGH = 1.05
#: where other packages offer label volumes as cases, and a unit of time
PLUGINS = "gcar.benchmark"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class BenchCase:
    """Pictures with their truth.

    Attributes
    ----------
    name : str
    angiograms : tuple of Angiogram
    grid : Grid
    truth : (nx, ny, nz) occupancy
    centreline_mm : (n, 3) points of the true centreline, mm LPS
    """

    name: str
    angiograms: tuple[Angiogram, ...]
    grid: Grid
    truth: Volume
    centreline_mm: Points


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cell:
    """One setting. ``gaussians`` is a cap for the paper's refiner, None elsewhere."""

    predictor: PredictorName
    refiner: RefinerName
    iterations: int
    gaussians: int | None
    pixels: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One cell on one case; None where it does not apply or could not be had.

    Attributes
    ----------
    case, status : str
    cell : Cell
    used : Gaussians in the result
    p50_s, p95_s : seconds of a warm reconstruction, pictures in memory to volume in memory
    pairs : p50 in units of one itk-rtk projection pair timed beside it
    peak_mb : highest resident memory while it ran
    dsc : volume DSC at 0.5
    rmse_mm, p95_mm : distance between the centreline and the true one, both ways
    over_bound : rmse over the Cramer-Rao bound
    """

    case: str
    cell: Cell
    status: str
    used: int | None = None
    p50_s: float | None = None
    p95_s: float | None = None
    pairs: float | None = None
    peak_mb: float | None = None
    dsc: float | None = None
    rmse_mm: float | None = None
    p95_mm: float | None = None
    over_bound: float | None = None


def cells(quick: bool) -> list[Cell]:
    """Return the grid; what a refiner has no use for is not varied."""
    sides = (128, 512) if quick else (128, 256, 512)
    varied: tuple[tuple[RefinerName, tuple[int, ...], tuple[int | None, ...]], ...] = (
        ("none", (0,), (None,)),
        ("tube", (1, 6) if quick else (1, 2, 4, 6, 12), (None,)),
        ("paper", (25,) if quick else (25, 50, 150), (300,) if quick else (100, 300, 1000, 3000)),
    )
    out = []
    for predictor in ("multi", "none"):
        for pixels in sides:
            for refiner, iterations, caps in varied:
                out += [
                    Cell(
                        predictor=predictor,
                        refiner=refiner,
                        iterations=steps,
                        gaussians=cap,
                        pixels=pixels,
                    )
                    for steps in iterations
                    for cap in caps
                ]
    return out


def demo() -> BenchCase:
    """Return the case that comes along."""
    case = demo_case()
    angiograms, grid, _ = prepare(case.pictures, case.geometry, RunOptions())
    return BenchCase(
        name="demo",
        angiograms=tuple(angiograms),
        grid=grid,
        truth=case.truth(),
        centreline_mm=case.centreline_mm(),
    )


def label_cases(folder: Path) -> list[BenchCase]:
    """Simulate views of the label volumes below a folder.

    Raises
    ------
    UsageError
        The workshop (extra ``export``) is not installed, or there is no label volume.
    """
    make = plugin("label-cases")
    if make is None:
        raise UsageError("label volumes need the workshop: pip install 'gcar[export]'")
    cases: list[BenchCase] = make(folder)
    return cases


def pair_seconds(case: BenchCase) -> Callable[[], float] | None:
    """Return what times one itk-rtk projection pair, or None where itk-rtk is not installed."""
    make = plugin("pair-timer")
    if make is None:
        return None
    try:
        timer: Callable[[], float] = make(case.truth, case.grid)
    except ImportError:
        return None
    return timer


def plugin(name: str) -> Any:
    """Load what another package offers under ``name``; None where there is none."""
    for entry in entry_points(group=PLUGINS, name=name):
        try:
            return entry.load()
        except ImportError:
            return None
    return None


def options_of(cell: Cell) -> RunOptions:
    """Return the runtime's options for a cell."""
    options = RunOptions()
    refine = options.refine
    if cell.refiner == "tube":
        steps = (cell.iterations, cell.iterations)
        refine = dataclasses.replace(refine, tube=dataclasses.replace(refine.tube, steps=steps))
    elif cell.refiner == "paper":
        paper = dataclasses.replace(
            refine.paper, steps=cell.iterations, most_gaussians=cell.gaussians or 1
        )
        refine = dataclasses.replace(refine, paper=paper)
    return dataclasses.replace(
        options,
        predict=dataclasses.replace(options.predict, predictor=cell.predictor),
        refine=dataclasses.replace(refine, refiner=cell.refiner),
    )


def at_size(angiograms: Sequence[Angiogram], pixels: int) -> list[Angiogram]:
    """Average pictures down to ``pixels`` along their longer side; smaller ones stay."""
    out = []
    for one in angiograms:
        share = pixels / max(one.pixels.shape)
        if share < 1:
            rows, columns = (max(round(n * share), 1) for n in one.pixels.shape)
            one = dataclasses.replace(
                one,
                carm=one.carm.resized(rows, columns),
                pixels=area_average(one.pixels, rows, columns),
            )
        out.append(one)
    return out


def run(
    cases: Sequence[BenchCase],
    grid: Sequence[Cell],
    *,
    repeats: int = 5,
    threads: int | None = None,
    pair: Callable[[], float] | None = None,
) -> Iterator[Row]:
    """Reconstruct every cell of every case and yield its row.

    Parameters
    ----------
    cases : BenchCase
    grid : Cell
    repeats : timed runs of each cell, after one that is not
    threads : of the predictor
    pair : what times one itk-rtk pair, called between the runs; None leaves ``pairs`` out
    """
    engines: dict[RunOptions, Engine] = {}
    for case in cases:
        bound = _bound_mm(case)
        for cell in grid:
            options = options_of(cell)
            if options not in engines:
                engines.clear()
                engines[options] = Engine(options=options, threads=threads)
            yield _row(case, cell, engines[options], bound, repeats, pair)


def _row(
    case: BenchCase,
    cell: Cell,
    engine: Engine,
    bound_mm: float,
    repeats: int,
    pair: Callable[[], float] | None,
) -> Row:
    views = at_size(case.angiograms, cell.pixels)
    _forget_peak()
    try:
        result = engine.reconstruct(views, case.grid)
    except GcarError as error:
        status = {6: "refused", 8: "failed"}.get(error.exit_code, "error")
        return Row(case=case.name, cell=cell, status=status)
    peak = _peak_mb()
    seconds, units = [], []
    for _ in range(repeats):
        start = time.perf_counter()
        engine.reconstruct(views, case.grid)
        seconds.append(time.perf_counter() - start)
        if pair is not None:
            units.append(seconds[-1] / pair())
    # Both ways, so that neither a ghost nor a missing branch comes free.
    made = points_every(result.tree, 0.25)
    there = cKDTree(case.centreline_mm).query(made)[0]
    missed = cKDTree(made).query(case.centreline_mm)[0]
    rmse = float(np.sqrt(0.5 * (np.mean(there**2) + np.mean(missed**2))))
    return Row(
        case=case.name,
        cell=cell,
        status=result.quality.status,
        used=len(result.gaussians),
        p50_s=float(np.median(seconds)),
        p95_s=float(np.quantile(seconds, 0.95)),
        pairs=float(np.median(units)) if units else None,
        peak_mb=peak,
        dsc=volume_dice(case.truth, result.volume).value,
        rmse_mm=rmse,
        p95_mm=float(np.quantile(np.concatenate([there, missed]), 0.95)),
        over_bound=rmse / bound_mm,
    )


def front(rows: Sequence[Row]) -> list[Row]:
    """Return the Pareto front: rows than which none is both faster and better, by time."""
    usable = [r for r in rows if r.p50_s is not None and r.rmse_mm is not None]
    out: list[Row] = []
    for row in sorted(usable, key=lambda r: (r.p50_s or 0.0, r.rmse_mm or 0.0)):
        if not out or (row.rmse_mm or 0.0) < (out[-1].rmse_mm or 0.0):
            out.append(row)
    return out


def knee(rows: Sequence[Row]) -> Row | None:
    """Return the cheapest row of the front past which more work buys nothing."""
    best = front(rows)
    if not best:
        return None
    least = min(r.rmse_mm or 0.0 for r in best)
    return next(r for r in best if (r.rmse_mm or 0.0) <= GOOD_ENOUGH * least)


def _bound_mm(case: BenchCase) -> float:
    """Root mean square Cramer-Rao bound of the centreline's points."""
    sigma, _ = point_sigmas([a.carm for a in case.angiograms], case.centreline_mm, NOISE_PX)
    return float(np.sqrt(np.mean(np.sum(sigma**2, axis=1))))


def _forget_peak() -> None:
    """Start the kernel's record of the highest resident memory anew, where there is one."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def _peak_mb() -> float | None:
    """Highest resident memory since ``_forget_peak``; None where the system does not tell."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    found = [line.split()[1] for line in lines if line.startswith("VmHWM:")]
    return int(found[0]) / 1024 if found else None
