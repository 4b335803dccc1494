"""Time of a warm reconstruction as a multiple of one itk-rtk projection pair.

Absolute times on shared machines mean little; the ratio of two things timed in one run
does. One pair is one Joseph forward and one Joseph back projection, 128^3 voxels, two
128x128 views, with the filters' own default threads.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.types import Volume
from gcar_export.methods import rtk_geometry
from gcar_export.scenes.protocols import Case, case_geometry


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairTiming:
    """Seconds, each the median of ``repeats``, taken in turns in one process.

    Attributes
    ----------
    forward_s, back_s : one RTK projection of both views each way
    reconstruct_s : one warm reconstruction, pictures in memory to volume in memory
    stages_s : stage -> median seconds of the reconstruction
    repeats : timings of each
    """

    forward_s: float
    back_s: float
    reconstruct_s: float
    stages_s: dict[str, float]
    repeats: int

    @property
    def pair_s(self) -> float:
        """One forward and one back projection."""
        return self.forward_s + self.back_s

    @property
    def ratio(self) -> float:
        """Warm reconstruction over one pair."""
        return self.reconstruct_s / self.pair_s


def time_pair(case: Case, repeats: int = 7) -> PairTiming:
    """Time the pair and the reconstruction of ``case`` in turns, after one untimed round."""
    from gcar_deploy.engine import Engine

    engine = Engine()
    angiograms, grid = case.angiograms(), case.grid
    forward, back = projection_pair(case.truth, grid, case.scene_carms)
    stages: list[Any] = []

    def reconstruct() -> None:
        stages.append(engine.reconstruct(angiograms, grid).seconds)

    seconds: dict[str, list[float]] = {"forward": [], "back": [], "reconstruct": []}
    for round_ in range(repeats + 1):
        for name, work in (("forward", forward), ("back", back), ("reconstruct", reconstruct)):
            start = time.perf_counter()
            work()
            if round_:
                seconds[name].append(time.perf_counter() - start)
    median = {name: statistics.median(values) for name, values in seconds.items()}
    return PairTiming(
        forward_s=median["forward"],
        back_s=median["back"],
        reconstruct_s=median["reconstruct"],
        stages_s={k: statistics.median(s[k] for s in stages[1:]) for k in stages[-1]},
        repeats=repeats,
    )


def pair_carms() -> list[CArm]:
    """Return the two views of the unit: the paper's set-up, 128x128 pixels."""
    return case_geometry("paper", 2)[0]


def pair_clock(volume: Volume, grid: Grid, carms: Sequence[CArm]) -> Callable[[], float]:
    """Return what runs one forward + back projection and says how long it took, s; warmed up."""
    forward, back = projection_pair(volume, grid, carms)

    def seconds() -> float:
        start = time.perf_counter()
        forward()
        back()
        return time.perf_counter() - start

    seconds()
    return seconds


def projection_pair(
    volume: Volume, grid: Grid, carms: Sequence[CArm]
) -> tuple[Callable[[], None], Callable[[], None]]:
    """Return the forward and the back projection as calls that do the work each time."""
    rtk = rtk_geometry.rtk()
    pictures = rtk_geometry.stack(rtk_geometry.forward(volume, grid, carms), carms)
    empty, filled = rtk_geometry.stack(None, carms), rtk_geometry.volume_image(volume, grid)
    blank = rtk_geometry.volume_image(np.zeros(grid.shape, np.float32), grid)
    geometry = rtk_geometry.geometry(carms)

    def prepared(cls: Any, first: Any, second: Any) -> Callable[[], None]:
        projector = cls[type(first), type(second)].New()
        projector.SetInput(0, first)
        projector.SetInput(1, second)
        projector.SetGeometry(geometry)
        projector.InPlaceOff()

        def run() -> None:
            projector.Modified()
            projector.Update()

        return run

    return (
        prepared(rtk.JosephForwardProjectionImageFilter, empty, filled),
        prepared(rtk.JosephBackProjectionImageFilter, blank, pictures),
    )
