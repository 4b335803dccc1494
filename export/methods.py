"""The rows of the tables: each method from a simulated case to a volume, settings in one place.

Everything but the baselines goes through the runtime's own ``Engine``, exactly as a host
program would use it.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from gcar_deploy.config import RunOptions
from gcar_deploy.errors import GcarError, UsageError
from gcar_deploy.types import Image, Volume
from gcar_export.protocols import Case

#: method -> (predictor, refiner) of the runtime.
RUNTIME_METHODS: Mapping[str, tuple[str, str]] = {
    "hull": ("none", "none"),
    "hull+paper": ("none", "paper"),
    "hull+tube": ("none", "tube"),
    "single": ("single", "none"),
    "single+paper": ("single", "paper"),
    "single+tube": ("single", "tube"),
    "multi": ("multi", "none"),
    "multi+paper": ("multi", "paper"),
    "multi+tube": ("multi", "tube"),
}
#: what the runtime does when asked for nothing in particular.
OURS = "ours"
BASELINES = ("fdk", "sart", "visual_hull")
METHODS = (OURS, *RUNTIME_METHODS, *BASELINES)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Solved:
    """What one method made of one case.

    Attributes
    ----------
    volume : (nx, ny, nz) float32 on the case's grid, or None if there is none
    seconds : stage -> wall-clock seconds; ``total`` among them
    gaussians : number of Gaussians, None where the method has none
    status : ``ok``, ``degraded``, ``refused``, ``failed``
    sentence : why
    """

    volume: Volume | None
    seconds: Mapping[str, float]
    gaussians: int | None
    status: str
    sentence: str


def solve(case: Case, method: str) -> Solved:
    """Run one method on one case.

    A case that the method refuses or fails on is a result with a status, not an exception.

    Raises
    ------
    UsageError
        On an unknown method.
    """
    if method not in METHODS:
        raise UsageError(f"method {method!r} is none of {', '.join(METHODS)}")
    start = time.perf_counter()
    try:
        if method in BASELINES:
            # Importing itk takes seconds: before the clock starts.
            run = _baseline(method)
            start = time.perf_counter()
            volume = run(case)
            total = time.perf_counter() - start
            return Solved(
                volume=volume, seconds={"total": total}, gaussians=None, status="ok", sentence=""
            )
        return _runtime(case, run_options(method))
    except GcarError as error:
        status = "refused" if error.exit_code == 6 else "failed"
        return Solved(
            volume=None,
            seconds={"total": time.perf_counter() - start},
            gaussians=None,
            status=status,
            sentence=str(error),
        )


def run_options(method: str) -> RunOptions:
    """Return the runtime's options for a method of ``RUNTIME_METHODS`` or ``OURS``."""
    options = RunOptions()
    if method == OURS:
        return options
    predictor, refiner = RUNTIME_METHODS[method]
    return dataclasses.replace(
        options,
        predict=dataclasses.replace(options.predict, predictor=predictor),
        refine=dataclasses.replace(options.refine, refiner=refiner),
    )


@dataclasses.dataclass(eq=False)
class _Session:
    """An engine, and whether it has run yet."""

    engine: Any
    warm: bool = False


@functools.cache
def _session(options: RunOptions) -> _Session:
    """One session per set of options and process."""
    from gcar_deploy.engine import Engine

    return _Session(Engine(options=options))


def _runtime(case: Case, options: RunOptions) -> Solved:
    session = _session(options)
    angiograms, grid = case.angiograms(), case.grid
    if not session.warm:
        # Times are those of a warm session: model loaded, modules imported.
        session.engine.reconstruct(angiograms, grid)
        session.warm = True
    start = time.perf_counter()
    result = session.engine.reconstruct(angiograms, grid)
    total = time.perf_counter() - start
    return Solved(
        volume=result.volume,
        seconds={**result.seconds, "total": total},
        gaussians=int(result.counts["gaussians"]),
        status=result.quality.status,
        sentence=result.quality.sentence,
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


def _baseline(method: str) -> Callable[[Case], Volume]:
    if method == "visual_hull":
        return _visual_hull
    from gcar_export.baselines.fdk import fdk
    from gcar_export.baselines.sart import sart
    from gcar_export.rtk_geometry import rtk

    rtk()
    solver = fdk if method == "fdk" else sart
    return lambda case: solver(path_lengths(case), case.scene_carms, case.grid)


def _visual_hull(case: Case) -> Volume:
    from gcar_export.baselines.visual_hull import visual_hull

    return visual_hull(path_lengths(case), case.scene_carms, case.grid)
