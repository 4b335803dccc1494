"""What refinement costs: CPU seconds against Gaussians, views and pixels, with the exponents.

An exponent is the slope of log seconds over log size by least squares: 1 is proportional, 0 free.
CPU seconds of this process, the least of ``REPEATS``, so that other work on the machine counts
little.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence

import numpy as np

from gcar_deploy.config import RefineOptions
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.gaussians.gaussians import Gaussians
from gcar_deploy.gaussians.project import project, project_vjp
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.selftest import EDGE_MM, tiny_tree
from gcar_deploy.tree.occupancy import tree_occupancy
from gcar_deploy.tubes.model import Tubes, footprint, tubes_of
from gcar_deploy.tubes.refine import refine

GAUSSIANS = (100, 300, 1000, 3000, 10_000)
VIEWS = (2, 4, 8, 16)
PIXELS = (128, 256, 512, 1024)
REPEATS = 3


@dataclasses.dataclass(frozen=True)
class Curve:
    """Seconds for each size, and the exponent of their growth."""

    name: str
    sizes: tuple[int, ...]
    seconds: tuple[float, ...]

    @property
    def exponent(self) -> float:
        """Slope of log seconds over log size."""
        return float(np.polyfit(np.log(self.sizes), np.log(self.seconds), 1)[0])


def curves(on_point: Callable[[], None] | None = None) -> list[Curve]:
    """Measure all three."""
    out = []
    for name, sizes, work in (
        ("Gaussians (one gradient, paper refiner, 128 px)", GAUSSIANS, _gradient),
        ("views (whole tube refinement, 256 px)", VIEWS, lambda n: _tubes(n, 256)),
        ("pixels (whole tube refinement, 2 views)", PIXELS, lambda n: _tubes(2, n)),
    ):
        seconds = []
        for size in sizes:
            seconds.append(_least_s(work(size)))
            if on_point is not None:
                on_point()
        out.append(Curve(name, sizes, tuple(seconds)))
    return out


def table(found: Sequence[Curve]) -> str:
    """Markdown, one block per curve."""
    lines = []
    for curve in found:
        cells = ", ".join(
            f"{n}: {s:.3g} s" for n, s in zip(curve.sizes, curve.seconds, strict=True)
        )
        lines.append(f"- {curve.name}: {cells}; exponent {curve.exponent:.2f}")
    return "\n".join(lines)


def _least_s(work: Callable[[], object]) -> float:
    found = []
    for _ in range(REPEATS):
        start = time.process_time()
        work()
        found.append(time.process_time() - start)
    return max(min(found), 1e-6)


def _carm(primary: float, pixels: int) -> CArm:
    spacing = 1.2 * 128 / pixels
    return CArm(
        primary_angle_deg=primary, secondary_angle_deg=15.0, sod_mm=765.0, sdd_mm=1100.0,
        rows=pixels, columns=pixels, pixel_spacing_mm=(spacing, spacing),
    )  # fmt: skip


def _gradient(count: int) -> Callable[[], object]:
    rng = np.random.default_rng(0)
    g = Gaussians(
        means_mm=rng.uniform(-35, 35, (count, 3)),
        scales_mm=rng.uniform(0.6, 1.5, (count, 3)),
        quaternions_wxyz=rng.normal(size=(count, 4)),
        intensity=np.ones(count),
    )
    view = _carm(30.0, 128)
    return lambda: project_vjp(g, view, project(g, view))


def _tubes(views: int, pixels: int) -> Callable[[], object]:
    """Return a whole refinement of a small tree from its true points."""
    tree = tiny_tree()
    side = int(EDGE_MM)
    grid = Grid(center_mm=(0, 0, 0), size_mm=(EDGE_MM,) * 3, shape=(side,) * 3)
    volume = tree_occupancy(tree, grid)
    centers = CenterPoints(
        points_mm=grid.index2world(np.argwhere(volume > 0)),
        confidence=volume[volume > 0].astype(np.float64),
        radius_mm=np.full(int(np.count_nonzero(volume)), np.nan),
        spacing_mm=1.0,
        source="multi",
    )
    seen = [
        _seen(tubes_of(tree), _carm(-60.0 + 150.0 * k / views, pixels), k) for k in range(views)
    ]
    return lambda: refine(centers, seen, RefineOptions())


def _seen(tubes: Tubes, view: CArm, number: int) -> VesselImage:
    path = footprint(tubes, view, 1.0).image((view.rows, view.columns)).astype(np.float32)
    return VesselImage(
        view_id=str(number), carm=view, path_mm=path, path_error=0.0, mask=path > 0.1,
        skeleton=np.zeros(path.shape, bool), valid=np.ones(path.shape, bool), kind="path_length",
    )  # fmt: skip
