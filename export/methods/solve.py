"""The rows of the tables: each method from a simulated case to a volume.

What a row is, and its settings, stand in ``settings``. Everything but the baselines
goes through the runtime's own ``Engine``, exactly as a host program would use it.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gcar_deploy.config import RunOptions
from gcar_deploy.errors import GcarError, ModelError, UsageError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.types import Image, Points, Volume
from gcar_export.methods.own_models import OwnModels
from gcar_export.methods.settings import (
    METHODS,
    RUNTIME_ROWS,
    START_ROWS,
    TRUE_DEPTH,
    MethodSettings,
    RuntimeRow,
)
from gcar_export.scenes.protocols import Case
from gcar_export.scenes.thin_protocol import along


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Solved:
    """What one method made of one case.

    Attributes
    ----------
    volume : (nx, ny, nz) float32 on the case's grid, or None if there is none
    seconds : stage -> wall-clock seconds; ``total`` among them, and ``cpu``, the CPU seconds of
        all threads, which tell more than the clock on a machine that others use
    gaussians : number of Gaussians, None where the method has none
    status : ``ok``, ``degraded``, ``refused``, ``failed``
    sentence : why
    line_mm : (n, 3) points along the tree's centreline, mm LPS; None where there is no tree
    """

    volume: Volume | None
    seconds: Mapping[str, float]
    gaussians: int | None
    status: str
    sentence: str
    line_mm: Points | None = None


def solve(case: Case, method: str, settings: MethodSettings | None = None) -> Solved:
    """Run one method on one case.

    A case that the method refuses or fails on is a result with a status, not an exception.

    Raises
    ------
    UsageError
        On an unknown method.
    ModelError
        The method's model is missing.
    """
    settings = settings or MethodSettings()
    if method not in METHODS:
        raise UsageError(f"method {method!r} is none of {', '.join(METHODS)}")
    clock = _Clock()
    try:
        if method in RUNTIME_ROWS:
            options = settings.run_options(method)
            own = settings.own_models(method)
            session = _session(options, own, own.said())
            return _runtime(case, session, RUNTIME_ROWS[method])
        _warm_up(method)
        clock = _Clock()
        if method in START_ROWS:
            volume, gaussians, sentence = _started(case, method, settings)
        else:
            volume, gaussians, sentence = _baseline(case, method, settings), None, ""
        return Solved(
            volume=volume,
            seconds=clock.read(),
            gaussians=gaussians,
            status="ok",
            sentence=sentence,
        )
    except ModelError:
        raise
    except GcarError as error:
        return Solved(
            volume=None,
            seconds=clock.read(),
            gaussians=None,
            status="refused" if error.exit_code == 6 else "failed",
            sentence=str(error),
        )


def check_models(methods: Sequence[str], settings: MethodSettings) -> None:
    """Load what the methods need, before any work is done.

    Raises
    ------
    ModelError
        A method's model is missing or altered; the message names the method.
    """
    for method in methods:
        if method in RUNTIME_ROWS:
            try:
                own = settings.own_models(method)
                _session(settings.run_options(method), own, own.said())
            except ModelError as error:
                raise ModelError(f"method {method}: {error}") from None


class _Clock:
    """Wall-clock and CPU seconds since it was made."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def read(self) -> dict[str, float]:
        """Return ``total`` and ``cpu``."""
        wall, cpu = time.perf_counter() - self._wall, time.process_time() - self._cpu
        return {"total": wall, "cpu": cpu}


@dataclasses.dataclass(eq=False)
class _Session:
    """An engine, and whether it has run yet."""

    engine: Any
    warm: bool = False


@functools.cache
def _session(options: RunOptions, own: OwnModels, _: str) -> _Session:
    """One session per set of options, models (and what is in their files) and process.

    Without its model the runtime falls back to the hull; a row must never do so unsaid.
    """
    from gcar_deploy.engine import Engine

    engine = Engine(model=own.predictor, options=options, segmenter_model=own.segmenter)
    predictor = options.predict.predictor
    if predictor != "none" and engine.model is None:
        raise ModelError(f"predictor {predictor} has no model in this version")
    return _Session(engine)


def _runtime(case: Case, session: _Session, row: RuntimeRow) -> Solved:
    angiograms, grid = case.angiograms(), case.grid
    if row.swapped:
        angiograms = angiograms[::-1]
    if row.grey_masks:
        angiograms = [_as_grey(angiogram) for angiogram in angiograms]
    if not session.warm:
        # Times are those of a warm session: model loaded, modules imported.
        session.engine.warmup()
        session.warm = True
    clock = _Clock()
    result = session.engine.reconstruct(angiograms, grid)
    return Solved(
        volume=result.volume,
        seconds={**result.seconds, **clock.read()},
        gaussians=int(result.counts["gaussians"]),
        status=result.quality.status,
        sentence=result.quality.sentence,
        line_mm=None
        if case.line_mm is None
        else along([b.points_mm for b in result.tree.branches]),
    )


def _as_grey(angiogram: Angiogram) -> Angiogram:
    """Return a mask as a raw picture of its brightness; other pictures as they are."""
    if angiogram.intensity.kind != "mask":
        return angiogram
    return dataclasses.replace(
        angiogram, intensity=dataclasses.replace(angiogram.intensity, kind="raw")
    )


def path_lengths(case: Case) -> list[Image]:
    """Pictures as path lengths in mm, as the baselines want them.

    Calibrated pictures are scaled as they say; raw ones go through the runtime's own vessel
    extraction first, so that every method starts from the same evidence.
    """
    from gcar_deploy.imaging.extract import extract_vessels

    out = []
    for angiogram in case.angiograms():
        scale = angiogram.intensity.mm_per_count
        if angiogram.intensity.kind == "path_length" and scale is not None:
            out.append(angiogram.pixels * np.float32(scale))
        else:
            out.append(extract_vessels(angiogram, RunOptions().imaging).path_mm)
    return out


def voxel_sized(case: Case) -> tuple[list[Image], list[CArm]]:
    """Path lengths and views with pixels of about a voxel at the isocentre, never finer ones.

    All views shrink alike, so that pictures of one size stay of one size.
    """
    from gcar_deploy.imaging.resample import area_average

    pictures, carms = path_lengths(case), case.scene_carms
    finest = float(np.min(case.grid.spacing_mm))
    scale = max(carm.pixel_at_isocenter_mm for carm in carms) / finest
    if scale >= 1:
        return pictures, carms
    sizes = [tuple(max(round(n * scale), 1) for n in picture.shape) for picture in pictures]
    return (
        [area_average(picture, *size) for picture, size in zip(pictures, sizes, strict=True)],
        [carm.resized(*size) for carm, size in zip(carms, sizes, strict=True)],
    )


@functools.cache
def _warm_up(method: str) -> None:
    """Load what takes seconds to load, once per process, before the clock starts.

    itk loads its filters when they are first made, so a tiny case is run for that.
    """
    if method == "nerp":
        import torch  # noqa: F401
    elif method != "visual_hull":
        from gcar_export.methods.fdk import fdk
        from gcar_export.methods.sart import SartOptions, sart

        grid = Grid(center_mm=(0, 0, 0), size_mm=(8, 8, 8), shape=(8, 8, 8))
        carm = CArm(
            primary_angle_deg=0, secondary_angle_deg=0, sod_mm=750, sdd_mm=1000, rows=8,
            columns=8, pixel_spacing_mm=(1.5, 1.5),
        )  # fmt: skip
        tiny = [np.ones((8, 8), np.float32)] * 2, [carm, carm.turned(90.0)], grid
        if method == "sart":
            sart(*tiny, SartOptions(iterations=1))
        else:
            fdk(*tiny)


def _baseline(case: Case, method: str, settings: MethodSettings) -> Volume:
    if method == "nerp":
        from gcar_export.methods.nerp import nerp

        return nerp(*voxel_sized(case), case.grid, settings.nerp)
    if method == "sart":
        from gcar_export.methods.sart import sart

        return sart(*voxel_sized(case), case.grid, settings.sart)
    given = path_lengths(case), case.scene_carms, case.grid
    if method == "visual_hull":
        from gcar_export.methods.visual_hull import visual_hull

        return visual_hull(*given, settings.hull_path_mm)
    from gcar_export.methods.fdk import fdk

    return fdk(*given, settings.fdk)


def _started(case: Case, method: str, settings: MethodSettings) -> tuple[Volume, int, str]:
    from gcar_deploy.gaussians.paper import refine_paper
    from gcar_deploy.gaussians.voxelize import voxelize
    from gcar_deploy.imaging.extract import extract_vessels
    from gcar_export.methods.fbp_gaussians import fbp_centers
    from gcar_export.methods.fdk import fdk
    from gcar_export.methods.true_depth import true_depth_centers

    given = path_lengths(case), case.scene_carms
    if method == TRUE_DEPTH:
        centers = true_depth_centers(case, given[0])
    else:
        start = fdk(*given, case.grid, settings.fdk)
        centers = fbp_centers(start, case.grid, *given, settings.fbp_gaussians)
    views = [extract_vessels(a, settings.run.imaging) for a in case.angiograms()]
    options = settings.started_options(method)
    fit = refine_paper(centers, views, options)
    volume = np.clip(voxelize(fit.gaussians, case.grid), 0.0, 1.0)
    return volume, len(fit.gaussians), f"{fit.steps} of at most {options.steps} steps"
