"""Are generated trees like real ones? Their numbers side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from scipy import ndimage

from gcar_deploy.config import CandidateOptions
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.measure.metrics import skeleton
from gcar_deploy.predict.hull import visual_hull
from gcar_export.scenes.labels import from_array, read_label
from gcar_export.scenes.protocols import make_case
from gcar_export.scenes.render import occupancy
from gcar_export.scenes.trees import TreeStyle, random_tree, rough_style, thin_style

#: voxel of the lattice on which both kinds are measured, mm
VOXEL_MM = 0.7
#: kinds of generated trees that training draws
STYLES: Mapping[str, Callable[[np.random.Generator], TreeStyle]] = {
    "label-like": lambda rng: TreeStyle(),
    "rough": rough_style,
    "thin": thin_style,
}
#: a thin vessel's radius, mm: hardly wider than the voxel
THIN_MM = 0.6
ROWS = (
    ("volume_mm3", "vessel volume, mm^3"),
    ("length_mm", "centreline length, mm"),
    ("radius_mm", "median radius, mm"),
    ("radius_10_mm", "10 % radius, mm"),
    ("radius_90_mm", "90 % radius, mm"),
    ("thin_share", f"share of length thinner than {THIN_MM:g} mm radius"),
    ("ends", "ends"),
    ("box_mm", "longest edge of the box, mm"),
    ("candidates", "hull cells per vessel cell (0/90 deg, 1.4 mm)"),
)


def statistics(occupied: np.ndarray, affine_ras: np.ndarray, spacing_mm: float) -> dict[str, float]:
    """Measure one tree.

    Parameters
    ----------
    occupied : (nx, ny, nz) bool
    affine_ras : (4, 4) index to mm RAS
    spacing_mm : edge of the cubic voxels, mm
    """
    line = skeleton(occupied, (spacing_mm,) * 3)
    index = np.rint(line.points_mm / spacing_mm).astype(int)
    mask = np.zeros_like(occupied)
    mask[tuple(index.T)] = True
    inside = ndimage.distance_transform_edt(occupied) * spacing_mm
    radius = inside[mask]
    around = ndimage.convolve(mask.astype(np.int8), np.ones((3, 3, 3), np.int8), mode="constant")
    label = from_array(occupied, affine_ras, "tree")
    case = make_case(label, "paper", 2)
    views = [(a.carm, a.pixels * np.float32(a.intensity.mm_per_count)) for a in case.angiograms()]
    hull = visual_hull(views, case.grid, CandidateOptions())
    where = np.argwhere(occupied)
    return {
        "volume_mm3": float(occupied.sum() * spacing_mm**3),
        # A 26-connected line of n voxels is about 1.3 n voxels long.
        "length_mm": float(1.3 * mask.sum() * spacing_mm),
        "radius_mm": float(np.median(radius)),
        "radius_10_mm": float(np.percentile(radius, 10)),
        "radius_90_mm": float(np.percentile(radius, 90)),
        "thin_share": float((radius < THIN_MM).mean()),
        "ends": float((mask & (around == 2)).sum()),
        "box_mm": float(np.ptp(where, axis=0).max() * spacing_mm),
        "candidates": float(len(hull) / max(int((case.truth >= 0.5).sum()), 1)),
    }


def generated_statistics(seed: int, style: str = "label-like") -> dict[str, float]:
    """Voxelise one generated tree and measure it; what is thinner than a voxel from its radii."""
    rng = np.random.default_rng(seed)
    starts, ends, radii = random_tree(rng, STYLES[style](rng)).segments()
    half = float(np.abs(np.concatenate([starts, ends])).max()) + 4.0
    n = int(2 * half / VOXEL_MM)
    grid = Grid(center_mm=(0, 0, 0), size_mm=(n * VOXEL_MM,) * 3, shape=(n,) * 3)
    index = np.argwhere(ndimage.binary_dilation(_near(starts, ends, grid), iterations=6))
    share, _, _ = occupancy(grid.index2world(index), VOXEL_MM, starts, ends, radii, sub=2)
    occupied = np.zeros(grid.shape, bool)
    occupied[tuple(index.T)] = share >= 0.5
    length = np.linalg.norm(ends - starts, axis=1)
    thin = float(length[radii < THIN_MM].sum() / length.sum())
    return statistics(occupied, grid.affine_ras(), VOXEL_MM) | {"thin_share": thin}


def _near(starts: np.ndarray, ends: np.ndarray, grid: Grid) -> np.ndarray:
    """Voxels that the centrelines pass through."""
    out = np.zeros(grid.shape, bool)
    for t in np.linspace(0, 1, 4):
        index = np.rint(grid.world2index(starts + t * (ends - starts))).astype(int)
        out[tuple(np.clip(index, 0, np.array(grid.shape) - 1).T)] = True
    return out


def real_statistics(path: Path) -> dict[str, float]:
    """Resample one label volume to the common voxel and measure it."""
    label = read_label(path)
    spacing = np.asarray(label.grid.spacing_mm)
    shape = np.maximum(np.round(spacing * label.grid.shape / VOXEL_MM), 1).astype(int)
    grid = Grid(
        center_mm=label.grid.center_mm,
        size_mm=tuple((shape * VOXEL_MM).tolist()),
        shape=tuple(shape.tolist()),
    )
    occupied = label.on_grid(grid) >= 0.5
    return statistics(occupied, grid.affine_ras(), VOXEL_MM)


def table(columns: Mapping[str, list[dict[str, float]]]) -> str:
    """Markdown: mean (lowest .. highest) of each figure, one column per kind of tree."""
    shown = {name: rows for name, rows in columns.items() if rows}
    out = ["| |" + "".join(f" {name} ({len(rows)}) |" for name, rows in shown.items())]
    out.append("|---|" + "---|" * len(shown))
    for key, name in ROWS:
        cells = []
        for rows in shown.values():
            v = [r[key] for r in rows]
            cells.append(f" {np.mean(v):.4g} ({min(v):.4g} .. {max(v):.4g}) |")
        out.append(f"| {name} |" + "".join(cells))
    return "\n".join(out)
