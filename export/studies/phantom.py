"""Real X-rays of a physical phantom: fit some runs, predict the others, compare with the authors.

Vukicevic et al., Sci Rep 8:1711 (2018), Dataset I: six DICOM XA runs and the authors' own surface,
which they compared with CT (0.03 .. 2.46 mm). Four of the runs do not tell their pixel spacing;
it is that of the other two. The table may have moved between the runs, so each predicted run may
shift as a whole; nothing else is fitted to it.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from gcar_deploy.config import DicomOptions, ImagingOptions, RunOptions
from gcar_deploy.dicom.scene import read_views
from gcar_deploy.engine import Engine
from gcar_deploy.errors import ImageError, RefusedError, UsageError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import ray_gaps
from gcar_deploy.geometry.scene import Scene
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.quality.status import centreline_mask
from gcar_deploy.result import Result
from gcar_deploy.tree.surface import lumen_surface
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Mask, Points
from gcar_export.evaluate.alignment import align, read_stl, sample_surface

SPACING_MM = 0.390625
RUNS = ("IM1", "IM2", "IM3", "IM4", "IM7", "IM8")
#: what is fitted, every pair and two larger sets; the rest is predicted
PAIRS = tuple(itertools.combinations(RUNS, 2))
THREE = ("IM1", "IM7", "IM8")
FOUR = ("IM1", "IM4", "IM7", "IM8")
#: near enough, pixels
NEAR_PX = 3.0
#: a run may shift by so much, mm; distances beyond the cap do not pull
REACH_MM, CAP_PX = 30.0, 12.0
#: first steps of the simplex in the picture's plane and along the beam, mm
_FIRST_MM = (1.0, 1.0, 15.0)
#: what a millimetre along the beam costs, pixels of mean distance: rounding must not move a run
_BEAM_COST_PX = 0.005


@dataclasses.dataclass(frozen=True, eq=False)
class Prediction:
    """A run that was not fitted, and the tree reprojected into it.

    Attributes
    ----------
    name : str
    carm : CArm, the run's own with the estimated shift
    shift_mm : float
    share : of the run's skeleton within ``NEAR_PX`` of the reprojected centreline
    median_px : median distance of the run's skeleton from the reprojected centreline
    back_share : the same of the reprojected centreline from the skeleton
    """

    name: str
    carm: CArm
    shift_mm: float
    share: float
    median_px: float
    back_share: float


@dataclasses.dataclass(frozen=True, eq=False)
class SurfaceGap:
    """Distances of two surfaces after rigid alignment, mm, each way."""

    ours_median: float
    ours_95: float
    theirs_median: float
    theirs_95: float


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """One set of runs: its tree, or why there is none; the other runs; the authors' surface.

    ``marks_mm`` is the median distance between the rays of hand-picked landmarks in any two of
    the runs, where landmarks are known: a check of the poses that the fit knows nothing of.
    """

    runs: tuple[str, ...]
    result: Result | None
    refusal: str
    predictions: tuple[Prediction, ...]
    surface: SurfaceGap | None
    marks_mm: float | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Phantom:
    """What is known of the phantom.

    Attributes
    ----------
    angiograms, vessels : name of the run -> its frame, and what is vessel in it
    surface_points : (n, 3) on the authors' surface, in their frame, mm
    """

    angiograms: dict[str, Angiogram]
    scene: Scene
    vessels: dict[str, VesselImage]
    surface_points: Points


def load(data: Path) -> Phantom:
    """Read the runs and the authors' surface from ``phantom_xa`` in ``data`` or under ``data/``.

    Raises
    ------
    UsageError
        There is no such folder.
    """
    folders = [data / "phantom_xa", data / "data" / "phantom_xa", data]
    folder = next((f for f in folders if (f / "IM7.dcm").is_file()), None)
    if folder is None:
        raise UsageError(f"{data} holds no phantom_xa/IM7.dcm")
    found, scene, _ = read_views(
        [folder / f"{name}.dcm" for name in RUNS], DicomOptions(pixel_spacing_mm=SPACING_MM)
    )
    angiograms = dict(zip(RUNS, found, strict=True))
    try:
        corners, faces = read_stl((folder / "surface_coarse.stl").read_bytes())
    except (OSError, ValueError) as error:
        raise ImageError(f"surface_coarse.stl: {error}") from None
    return Phantom(
        angiograms=angiograms,
        scene=scene,
        vessels={n: extract_vessels(a, ImagingOptions()) for n, a in angiograms.items()},
        surface_points=sample_surface(corners, faces, 30_000),
    )


def read_landmarks(path: Path, names: Sequence[str]) -> tuple[Any, ...]:
    """Landmarks of the runs ``names`` from a JSON file with ``pixels_col_row``.

    Raises
    ------
    UsageError
        The file does not hold all of these runs.
    """
    try:
        pixels = json.loads(path.read_text(encoding="utf-8"))["pixels_col_row"]
        columns = [pixels[name] for name in names]
    except (OSError, ValueError, KeyError) as error:
        raise UsageError(f"{path.name}: no landmarks of {', '.join(names)} ({error})") from None
    return tuple(
        tuple((float(c), float(r)) for c, r in marks) for marks in zip(*columns, strict=True)
    )


def fit(
    phantom: Phantom, runs: tuple[str, ...], engine: Engine, landmarks: tuple[Any, ...] = ()
) -> Fit:
    """Reconstruct from ``runs``, predict the others, measure against the authors' surface."""
    chosen = [phantom.angiograms[name] for name in runs]
    grid = dataclasses.replace(
        phantom.scene,
        views=tuple(v for v, n in zip(phantom.scene.views, phantom.angiograms, strict=True)
                    if n in runs),
    ).volume_grid()  # fmt: skip
    if landmarks:
        engine = Engine(
            threads=engine.threads, options=dataclasses.replace(engine.options, landmarks=landmarks)
        )
    try:
        result = engine.reconstruct(chosen, grid)
    except RefusedError as error:
        return Fit(runs, None, str(error), (), None)
    others = [name for name in phantom.angiograms if name not in runs]
    predictions = tuple(predict(name, phantom.vessels[name], result.tree) for name in others)
    return Fit(runs, result, "", predictions, compare_surfaces(result.tree, phantom.surface_points))


def predict(name: str, view: VesselImage, tree: Tree) -> Prediction:
    """Estimate the shift of a run from its skeleton, then measure what the tree explains of it."""
    seen = view.skeleton & view.valid
    shift = estimate_shift(view.carm, seen, tree)
    carm = view.carm.moved(shift)
    line = centreline_mask(tree, carm)
    if not (line.any() and seen.any()):
        return Prediction(name, carm, float(np.linalg.norm(shift)), 0.0, np.inf, 0.0)
    gap, back = distance_px(line)[seen], distance_px(seen)[line & view.valid]
    return Prediction(
        name, carm, float(np.linalg.norm(shift)),
        float((gap <= NEAR_PX).mean()), float(np.median(gap)),
        float((back <= NEAR_PX).mean()) if len(back) else 0.0,
    )  # fmt: skip


def estimate_shift(carm: CArm, skeleton: Mask, tree: Tree) -> Array:
    """(3,) mm that lays the tree on the skeleton: a table moves up and down as well.

    Capped distances both ways: from a lattice of 2 mm over ``REACH_MM`` in the picture's plane,
    then by simplex, along the beam as well, which changes the magnification.
    """
    points = tree.points()
    far = np.minimum(distance_px(skeleton), CAP_PX)
    seen = np.argwhere(skeleton)[:, ::-1].astype(np.float64)

    def cost(shift: Array, both: bool) -> float:
        pixels = carm.moved(shift @ carm.axes).project(points)[0]
        at = np.rint(pixels).astype(int)
        inside = ((at >= 0) & (at < (carm.columns, carm.rows))).all(axis=1)
        own = np.where(inside, far[at[:, 1] * inside, at[:, 0] * inside], CAP_PX).mean()
        own += _BEAM_COST_PX * abs(shift[2])
        if not both:
            return float(own)
        gap = np.minimum(cKDTree(pixels).query(seen)[0], CAP_PX).mean()
        return float(own + gap)

    steps = np.arange(-REACH_MM, REACH_MM + 1e-9, 2.0)
    lattice = np.array([(a, b, 0.0) for a in steps for b in steps])
    rough = np.array([cost(s, False) for s in lattice])
    starts = lattice[np.argsort(rough)[:4]]
    found = [
        minimize(cost, s, args=(True,), method="Nelder-Mead",
                 options={"xatol": 0.02, "fatol": 1e-3, "maxfev": 240,
                          "initial_simplex": s + np.vstack([np.zeros(3), np.diag(_FIRST_MM)])})
        for s in starts
    ]  # fmt: skip
    best = min(found, key=lambda f: f.fun).x
    shift: Array = best @ carm.axes
    return shift


def distance_px(mask: Mask) -> Array:
    """(rows, cols) distance to the nearest true pixel; a large constant where there is none."""
    if not mask.any():
        return np.full(mask.shape, 1e6)
    out: Array = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    return out


def compare_surfaces(tree: Tree, reference: Points) -> SurfaceGap:
    """Distances between our lumen surface and points on another, after rigid alignment."""
    surface = lumen_surface(tree)
    ours = sample_surface(surface.vertices_mm, surface.faces, 8_000)
    moved = align(ours, reference).apply(ours)
    out, back = cKDTree(reference).query(moved)[0], cKDTree(moved).query(reference)[0]
    return SurfaceGap(
        *(float(x) for gap in (out, back) for x in (np.median(gap), np.percentile(gap, 95)))
    )


def run(
    data: Path, landmarks: Path | None = None, progress: Callable[[str], None] | None = None
) -> tuple[Phantom, list[Fit]]:
    """Fit every pair, three and four views; ``landmarks`` hold the four to each other."""
    phantom = load(data)
    engine = Engine(threads=1, options=RunOptions())
    fits = []
    for runs in (*PAIRS, THREE, FOUR):
        if progress is not None:
            progress(f"fitting {' + '.join(runs)}")
        fits.append(fit(phantom, runs, engine))
    if landmarks is not None:
        if progress is not None:
            progress(f"fitting {' + '.join(FOUR)} with landmarks")
        fits.append(fit(phantom, FOUR, engine, read_landmarks(landmarks, FOUR)))
        fits = [marked(one, landmarks) for one in fits]
    return phantom, fits


def marked(one: Fit, landmarks: Path) -> Fit:
    """Add how far the rays of the landmarks miss each other, if its runs have landmarks."""
    try:
        marks = np.array(read_landmarks(landmarks, one.runs))
    except UsageError:
        return one
    if one.result is None:
        return one
    carms = [view.carm for view in one.result.views]
    gaps = [
        ray_gaps(carms[i], carms[j], marks[:, i], marks[:, j])
        for i, j in itertools.combinations(range(len(carms)), 2)
    ]
    return dataclasses.replace(one, marks_mm=float(np.median(np.abs(np.concatenate(gaps)))))
