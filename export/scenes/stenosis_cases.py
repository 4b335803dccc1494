"""Left coronary trees with one stenosis of known severity, as vessels and as pictures."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.tree.centerline import build_tree
from gcar_deploy.tree.tree import Tree, along, polyline_arc
from gcar_export.scenes.labels import LabelVolume, read_label
from gcar_export.scenes.protocols import MM_PER_COUNT, clinical_geometry
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.trees import random_tree

#: percent diameter stenosis is drawn evenly from here
PERCENT = (30.0, 70.0)
#: length of the narrowing, end to end, mm
LENGTH_MM = (8.0, 16.0)
#: only vessels so long and so wide (median radius) get one, away from their ends and from others
MIN_VESSEL_MM, MIN_RADIUS_MM, END_SHARE, CLEAR_MM = 25.0, 1.0, 0.3, 4.0
#: the healthy radius round a narrowing is made a straight line so far beyond it, mm
HEALTHY_MM = 8.0
#: vessels with a lesion are drawn in pieces so short, mm: a piece has one radius and round ends,
#: and long ones would fill a narrow core that the truth has
PIECE_MM = 0.25
#: label volumes are turned into vessels on voxels of this edge, mm, radii smoothed over so much
LABEL_VOXEL_MM, RADIUS_SMOOTH_MM = 0.7, 3.0


@dataclasses.dataclass(frozen=True, eq=False)
class Tube:
    """One vessel: (m, 3) points, mm LPS, and (m,) radii, mm."""

    name: str
    points_mm: np.ndarray
    radius_mm: np.ndarray

    @property
    def arc_mm(self) -> np.ndarray:
        """(m,) distance from the first point, mm."""
        return polyline_arc(self.points_mm)


@dataclasses.dataclass(frozen=True, eq=False)
class Lesion:
    """Where the narrowing is: vessel number, arc of its middle, length, and how narrow it is."""

    vessel: int
    middle_mm: float
    length_mm: float
    percent: float
    minimal_diameter_mm: float


@dataclasses.dataclass(frozen=True, eq=False)
class StenosisCase:
    """Vessels with one lesion."""

    name: str
    vessels: tuple[Tube, ...]
    lesion: Lesion


def generated_tubes(seed: int) -> tuple[Tube, ...]:
    """Left tree of the generator."""
    tree = random_tree(np.random.default_rng(seed)).sides("left")
    return tuple(Tube(v.name, v.points_mm, v.radius_mm) for v in tree.vessels)


def label_tubes(path: Path) -> tuple[Tube, ...]:
    """Left tree of a label volume: its centreline with radii, as the runtime builds it."""
    out = []
    for k, branch in enumerate(thinned_label(path, "left").branches, start=1):
        step = branch.length_mm / max(len(branch) - 1, 1)
        radius = gaussian_filter1d(branch.radius_mm, RADIUS_SMOOTH_MM / max(step, 1e-6))
        out.append(Tube(str(k), branch.points_mm, radius))
    return tuple(out)


def thinned_label(path: Path, side: str) -> Tree:
    """Tree of one side (``left``, ``right``) of a label volume, centred, mm LPS."""
    sides = read_label(path).left_right()
    label: LabelVolume = sides[("left", "right").index(side)].centred().cropped()
    shape = np.ceil(np.asarray(label.grid.size_mm) / LABEL_VOXEL_MM).astype(int)
    grid = Grid(
        center_mm=label.grid.center_mm,
        size_mm=tuple((shape * LABEL_VOXEL_MM).tolist()),
        shape=(int(shape[0]), int(shape[1]), int(shape[2])),
    )
    volume = label.on_grid(grid)
    index = np.argwhere(volume > 0)
    return build_tree(
        CenterPoints(
            points_mm=grid.index2world(index),
            confidence=volume[volume > 0].astype(float),
            radius_mm=np.full(len(index), np.nan),
            spacing_mm=LABEL_VOXEL_MM,
            source="hull",
        )
    )


def with_stenosis(
    name: str, vessels: tuple[Tube, ...], rng: np.random.Generator, percent: float | None = None
) -> StenosisCase | None:
    """Narrow one vessel at a random place; None where no vessel has a place for it.

    ``percent`` : diameter stenosis; None draws it from ``PERCENT``
    """
    places = [
        (k, float(s))
        for k, vessel in enumerate(vessels)
        if vessel.arc_mm[-1] >= MIN_VESSEL_MM and np.median(vessel.radius_mm) >= MIN_RADIUS_MM
        for s in _clear(vessels, k)
    ]
    if not places:
        return None
    k, middle = places[int(rng.integers(len(places)))]
    changed = [_finer(vessel) for vessel in vessels]
    vessel, drawn, length = changed[k], rng.uniform(*PERCENT), rng.uniform(*LENGTH_MM)
    percent = drawn if percent is None else percent
    arc = vessel.arc_mm
    near = np.abs(arc - middle) <= length / 2 + HEALTHY_MM
    healthy = np.polyval(np.polyfit(arc[near], vessel.radius_mm[near], 1), arc)
    off = np.clip(2 * np.abs(arc - middle) / length, 0, 1)
    # A raised cosine: the full percentage in the middle, nothing at the ends.
    narrowed = healthy * (1 - percent / 100 * 0.5 * (1 + np.cos(np.pi * off)))
    radius = np.where(near, narrowed, vessel.radius_mm)
    least = 2 * float(healthy[np.argmin(np.abs(arc - middle))]) * (1 - percent / 100)
    changed[k] = dataclasses.replace(vessel, radius_mm=np.maximum(radius, 0.2))
    return StenosisCase(name, tuple(changed), Lesion(k, middle, length, percent, least))


def _finer(vessel: Tube) -> Tube:
    """Return the same vessel in steps of ``PIECE_MM``."""
    arc = vessel.arc_mm
    at = np.linspace(0.0, arc[-1], max(2, int(np.ceil(arc[-1] / PIECE_MM)) + 1))
    return Tube(vessel.name, along(vessel.points_mm, arc, at), np.interp(at, arc, vessel.radius_mm))


def _clear(vessels: tuple[Tube, ...], k: int) -> np.ndarray:
    """Arcs of vessel ``k`` that are clear of its ends and of every other vessel."""
    vessel = vessels[k]
    arc = vessel.arc_mm
    inner = (arc > END_SHARE * arc[-1]) & (arc < (1 - END_SHARE) * arc[-1])
    others = [v.points_mm for n, v in enumerate(vessels) if n != k]
    if others:
        gap, _ = cKDTree(np.concatenate(others)).query(vessel.points_mm)
        inner &= gap > CLEAR_MM
    return arc[inner]


def pictures(case: StenosisCase) -> tuple[list[Angiogram], Grid]:
    """Render the two clinical views as 16-bit path lengths."""
    a = np.concatenate([v.points_mm[:-1] for v in case.vessels])
    b = np.concatenate([v.points_mm[1:] for v in case.vessels])
    r = np.concatenate([0.5 * (v.radius_mm[1:] + v.radius_mm[:-1]) for v in case.vessels])
    carms, _, grid = clinical_geometry(2)
    out = []
    for k, carm in enumerate(carms, start=1):
        counts = np.rint(path_lengths(carm, a, b, r) / MM_PER_COUNT).clip(0, 65535)
        out.append(
            Angiogram(
                view_id=str(k), carm=carm, pixels=counts.astype(np.float32), bit_depth=16,
                intensity=Intensity(kind="path_length", polarity="bright",
                                    mm_per_count=MM_PER_COUNT),
                sha256="",
            )
        )  # fmt: skip
    return out, grid
