"""Training scenes: a generated tree, random views, what reaches us of them, the truth on the hull.

Scene i of seed s is a function of (s, i) alone, so a run can stop and go on anywhere.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.config import CandidateOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.resample import sampled_path
from gcar_deploy.predict.encoding import Encoded, encode
from gcar_deploy.predict.hull import Candidates, visual_hull
from gcar_deploy.tree.line_votes import THINNEST_CELLS
from gcar_deploy.types import Image
from gcar_export.scenes.capsules import Capsules, LabelTree
from gcar_export.scenes.pictures import PATH_ERRORS, as_mask, degrade, with_noise
from gcar_export.scenes.render import occupancy, path_lengths
from gcar_export.training.examinations import (
    MAX_POINTS,
    Examination,
    SceneOptions,
    examination,
    lattice_of,
)

#: thresholds of the hull that scenes are drawn with, cells of path; a few are lower
PATH_CELLS = (0.15, 0.5)
#: scenes with fewer candidates, or vessel among them, are drawn again, as are larger ones
FEWEST_POINTS, FEWEST_VESSEL = 300, 60


@dataclasses.dataclass(frozen=True, eq=False)
class TrainingScene:
    """One scene as the predictor meets it, with the truth at every candidate.

    ``views`` are (C-arm, path length in mm, calibrated), their paths off by the relative
    ``path_error``; ``hull`` is what they leave. ``line_mm`` are (m, 3) points of the true
    centreline, on the hull or not.
    """

    views: list[tuple[CArm, np.ndarray, bool]]
    hull: Candidates
    encoded: Encoded
    points_mm: np.ndarray
    spacing_mm: float
    occupancy: np.ndarray
    offset_cells: np.ndarray
    radius_cells: np.ndarray
    line_mm: np.ndarray
    path_error: float
    kind: str


def training_scene(
    seed: int,
    i: int,
    options: SceneOptions | None = None,
    labels: Sequence[LabelTree] = (),
) -> TrainingScene:
    """Draw scene ``i``; draws again (with a stated sub-seed) where a scene is unusable."""
    options = options or SceneOptions()
    for attempt in range(20):
        rng = np.random.default_rng([seed, i, attempt])
        drawn = examination(rng, options, labels)
        scene = None if drawn is None else _scene(rng, drawn, options)
        if scene is not None:
            return scene
    raise RuntimeError(f"no usable scene for seed {seed}, index {i}")


def _scene(
    rng: np.random.Generator, drawn: Examination, options: SceneOptions
) -> TrainingScene | None:
    h = drawn.h
    line = drawn.tree.moved(rng.uniform(-0.5, 0.5, size=3) * h)
    lumen = line.oval(rng) if rng.random() < options.oval_share else line
    kind = str(rng.choice(list(PATH_ERRORS), p=options.inputs))
    spoilt = rng.random() < options.spoilt_share
    misplaced = rng.random() < options.misplaced_share
    calibrated = kind == "exact" or (kind == "noisy" and rng.random() < 0.8)
    least = rng.uniform(0.1, 0.4) if drawn.thin else 0.5
    if rng.random() < 0.4:
        least = rng.uniform(0.15, 0.5)
    views = []
    for k, carm in enumerate(drawn.carms):
        true_carm = carm
        if misplaced and k:
            true_carm = carm.moved(rng.normal(size=3) * rng.uniform(0, 0.6) * max(h, 0.6))
        path = picture(rng, true_carm, lumen)
        carm, path = sampled(carm, given(rng, path, carm.pixel_at_isocenter_mm, kind, spoilt), h)
        views.append((carm, degrade(rng, path, h) if kind == "uncertain" else path, calibrated))
    lattice = lattice_of(drawn.middle_mm, drawn.radius_mm, h)
    hull = visual_hull([v[:2] for v in views], lattice, CandidateOptions(min_path_cells=least))
    if not FEWEST_POINTS < len(hull) < MAX_POINTS:
        return None
    truth, offset, radius = truth_at(hull.points_mm, h, lumen, line)
    if (truth >= 0.5).sum() < FEWEST_VESSEL:
        return None
    return TrainingScene(
        views=views,
        hull=hull,
        encoded=encode(hull, views),
        points_mm=hull.points_mm,
        spacing_mm=h,
        occupancy=truth.astype(np.float32),
        offset_cells=np.nan_to_num(offset / h).astype(np.float32),
        radius_cells=np.nan_to_num(radius / h).astype(np.float32),
        line_mm=0.5 * (line.starts + line.ends),
        path_error=PATH_ERRORS[kind],
        kind=f"{drawn.regime}-{kind}",
    )


def truth_at(
    points_mm: np.ndarray, h: float, lumen: Capsules, line: Capsules
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Occupancy of cells, and offset and radius (mm) of the nearest centreline.

    A vessel thinner than ``THINNEST_CELLS`` fills cells as one of that radius does: what is
    chosen by occupancy must not lose it.
    """
    thick = np.maximum(lumen.radii, THINNEST_CELLS * h)
    truth, offset, radius = occupancy(points_mm, h, lumen.starts, lumen.ends, thick)
    if lumen is line and np.array_equal(thick, line.radii):
        return truth, offset, radius
    _, offset, radius = occupancy(points_mm, h, line.starts, line.ends, line.radii, sub=1)
    return truth, offset, radius


def picture(rng: np.random.Generator, carm: CArm, tree: Capsules) -> Image:
    """Point-sampled rays, or a finer picture averaged down where pixels are coarse."""
    factor = 1
    if carm.rows <= 256 and rng.random() < 0.5:
        factor = int(rng.integers(2, 5))
    fine = carm.resized(carm.rows * factor, carm.columns * factor)
    path = path_lengths(fine, tree.starts, tree.ends, tree.radii)
    if factor > 1:
        path = cv2.resize(path, (carm.columns, carm.rows), interpolation=cv2.INTER_AREA)
    return np.asarray(path, dtype=np.float32)


def given(rng: np.random.Generator, path: Image, pixel_mm: float, kind: str, spoilt: bool) -> Image:
    """Return what an input of some kind tells of exact paths, mm, on the same pixels."""
    if kind == "noisy":
        return with_noise(rng, path, pixel_mm)
    if kind == "mask":
        return as_mask(rng, path, pixel_mm, spoilt)
    if kind == "uncertain" and spoilt:
        return np.where(as_mask(rng, path, pixel_mm, True) > 0, path, np.float32(0))
    return path


def sampled(carm: CArm, path: Image, pixel_mm: float) -> tuple[CArm, Image]:
    """Sample a picture for the lattice as the runtime does."""
    vessel = path > 0
    view = VesselImage(
        view_id="1", carm=carm, path_mm=path, path_error=0.0, mask=vessel, skeleton=vessel,
        valid=np.ones_like(vessel), kind="path_length",
    )  # fmt: skip
    return sampled_path(view, pixel_mm)
