"""What it costs: CPU seconds against Gaussians, vessel, views, pixels and voxels, with exponents.

An exponent is the slope of log seconds over log size by least squares: 1 is proportional, 0 free;
its 95 % interval is Student's, of what the line leaves. CPU seconds of this process, the least of
``REPEATS`` rounds over all sizes of all curves, so that other work on the machine counts little and
every size meets the same.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence

import numpy as np
from scipy.stats import t as student

from gcar_deploy.config import ImagingOptions, RefineOptions
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.gaussians.gaussians import Gaussians
from gcar_deploy.gaussians.project import project, project_vjp
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.imaging.net import load_segmenter
from gcar_deploy.selftest import EDGE_MM, tiny_tree
from gcar_deploy.tree.occupancy import tree_occupancy
from gcar_deploy.tree.tree import Branch, Tree
from gcar_deploy.tubes.model import Tubes, footprint, tubes_of
from gcar_deploy.tubes.refine import Refined, refine, refined_volume
from gcar_export.scenes.raw_pictures import raw_picture

GAUSSIANS = (100, 300, 1000, 3000, 10_000)
#: vessels side by side, each of ``VESSEL_MM``
VESSELS, VESSEL_MM = (1, 2, 4, 8), 40
VIEWS = (2, 4, 8, 16)
PIXELS = (128, 256, 512, 1024)
RAW_PIXELS = (256, 512, 1024, 2048)
#: voxels along an edge of the volume
EDGES = (48, 72, 108, 162)
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

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the exponent; infinite of fewer than three sizes."""
        x, y = np.log(self.sizes), np.log(self.seconds)
        if len(x) < 3:
            return -np.inf, np.inf
        left = y - np.polyval(np.polyfit(x, y, 1), x)
        free = len(x) - 2
        sd = np.sqrt(float(left @ left) / free / float(((x - x.mean()) ** 2).sum()))
        half = float(student.ppf(0.975, free)) * float(sd)
        return self.exponent - half, self.exponent + half


#: name of a curve -> size as it is printed -> what is timed
Works = dict[str, dict[int, Callable[[], object]]]


def works() -> Works:
    """Return what is timed, set up."""
    tree, rows = tiny_tree(), {n: _side_by_side(n) for n in VESSELS}
    return {
        "Gaussians (one gradient, paper refiner, 128 px)": {n: _gradient(n) for n in GAUSSIANS},
        "vessel in mm (whole tube refinement, 2 views, 256 px)": {
            n * VESSEL_MM: _tubes(rows[n], 2, 256) for n in VESSELS
        },
        "views (whole tube refinement, 256 px)": {n: _tubes(tree, n, 256) for n in VIEWS},
        "pixels along an edge (whole tube refinement, 2 views)": {
            n: _tubes(tree, 2, n) for n in PIXELS
        },
        "pixels along an edge (finding the vessels of one raw picture)": {
            n: _search(tree, n) for n in RAW_PIXELS
        },
        "voxels (volume of a fitted tree, 2 views, 256 px)": {n**3: _volume(n) for n in EDGES},
    }


def curves(on_point: Callable[[], None] | None = None, timed: Works | None = None) -> list[Curve]:
    """Measure all, the rounds one after the other."""
    timed = works() if timed is None else timed
    least = {name: dict.fromkeys(sizes, np.inf) for name, sizes in timed.items()}
    for _ in range(REPEATS):
        for name, sizes in timed.items():
            for size, work in sizes.items():
                start = time.process_time()
                work()
                spent = max(time.process_time() - start, 1e-6)
                least[name][size] = min(least[name][size], spent)
                if on_point is not None:
                    on_point()
    return [Curve(name, tuple(found), tuple(found.values())) for name, found in least.items()]


def table(found: Sequence[Curve]) -> str:
    """Markdown, one block per curve."""
    lines = []
    for curve in found:
        cells = ", ".join(
            f"{n}: {s:.3g} s" for n, s in zip(curve.sizes, curve.seconds, strict=True)
        )
        low, high = curve.interval
        lines.append(
            f"- {curve.name}: {cells}; exponent {curve.exponent:.2f} ({low:.2f} .. {high:.2f})"
        )
    return "\n".join(lines)


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


def _side_by_side(count: int) -> Tree:
    """Return so many bent vessels above each other, none joined."""
    t = np.linspace(0.0, 1.0, VESSEL_MM + 1)[:, None]
    lines = [
        np.array([-20.0, 0.0, 7.0 * (k - (count - 1) / 2)])
        + t * np.array([38.0, 0.0, 0.0]) + np.sin(np.pi * t) * np.array([0.0, 6.0, 2.0])
        for k in range(count)
    ]  # fmt: skip
    branches = tuple(
        Branch(
            points_mm=line, radius_mm=np.linspace(1.5, 1.0, len(line)),
            sigma_mm=np.full(len(line), np.nan), confidence=np.ones(len(line)),
            start=2 * k, end=2 * k + 1,
        )
        for k, line in enumerate(lines)
    )  # fmt: skip
    nodes = np.concatenate([line[[0, -1]] for line in lines])
    return Tree(nodes_mm=nodes, branches=branches)


def _grid(edge: int) -> Grid:
    return Grid(center_mm=(0, 0, 0), size_mm=(EDGE_MM,) * 3, shape=(edge,) * 3)


def _tubes(tree: Tree, views: int, pixels: int) -> Callable[[], Refined]:
    """Return a whole refinement of a tree from its true points."""
    grid = _grid(int(EDGE_MM))
    volume = tree_occupancy(tree, grid)
    centers = CenterPoints(
        points_mm=grid.index2world(np.argwhere(volume > 0)),
        confidence=volume[volume > 0].astype(np.float64),
        radius_mm=np.full(int(np.count_nonzero(volume)), np.nan),
        spacing_mm=1.0,
        source="multi",
    )
    seen = _views(tree, views, pixels)
    return lambda: refine(centers, seen, RefineOptions())


def _search(tree: Tree, pixels: int) -> Callable[[], object]:
    """Return the search for vessels in a raw picture of a tree."""
    segmenter = load_segmenter("auto")
    rng = np.random.default_rng(pixels)
    (seen,) = _views(tree, 1, pixels)
    picture = Angiogram(
        view_id="1", carm=seen.carm, pixels=raw_picture(seen.path_mm, rng).astype(np.float32),
        bit_depth=8, intensity=Intensity(kind="raw", polarity="dark"), sha256=str(pixels),
    )  # fmt: skip
    return lambda: extract_vessels(picture, ImagingOptions(), segmenter)


def _volume(edge: int) -> Callable[[], object]:
    """Return the volume of a small tree after its fit."""
    tree = tiny_tree()
    refined, seen, grid = _tubes(tree, 2, 256)(), _views(tree, 2, 256), _grid(edge)
    return lambda: refined_volume(refined, seen, grid)


def _views(tree: Tree, count: int, pixels: int) -> list[VesselImage]:
    tubes = tubes_of(tree)
    return [_seen(tubes, _carm(-60.0 + 150.0 * k / count, pixels), k) for k in range(count)]


def _seen(tubes: Tubes, view: CArm, number: int) -> VesselImage:
    path = footprint(tubes, view, 1.0).image((view.rows, view.columns)).astype(np.float32)
    return VesselImage(
        view_id=str(number), carm=view, path_mm=path, path_error=0.0, mask=path > 0.1,
        skeleton=np.zeros(path.shape, bool), valid=np.ones(path.shape, bool), kind="path_length",
    )  # fmt: skip
