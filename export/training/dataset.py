"""Training scenes: a generated tree, random views, degradations, and the truth on the hull.

Scene i of seed s is a function of (s, i) alone, so a run can stop and go on anywhere.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.config import CandidateOptions
from gcar_deploy.geometry.carm import CArm, separation_deg
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.predict.encoding import Encoded, encode
from gcar_deploy.predict.hull import Candidates, visual_hull
from gcar_deploy.types import Array
from gcar_export.scenes.render import occupancy, path_lengths
from gcar_export.scenes.trees import random_tree

#: scenes with more candidates are drawn again: they cost more than they teach
MAX_POINTS = 30_000
#: (primary, secondary) of the paper's two views, and of those that are usual in practice
PAPER_VIEWS = ((0, 0), (90, 0))
USUAL_VIEWS = ((-30, -20), (45, 25), (-30, 25), (45, -25), (0, 35), (0, -30))
USUAL_SPREAD_DEG = 5.0
NET_PIXELS = 128


@dataclasses.dataclass(frozen=True)
class SceneOptions:
    """Shares of what is drawn; probabilities unless named otherwise."""

    paper_share: float = 0.45
    exact_share: float = 0.65
    misplaced_share: float = 0.2
    more_views_share: float = 0.12
    #: scenes drawn from users' label volumes where some are given
    label_share: float = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class Capsules:
    """A tree as capsules: (n, 3) starts and ends in mm LPS, (n,) radii in mm."""

    starts: np.ndarray
    ends: np.ndarray
    radii: np.ndarray

    def moved(self, shift_mm: np.ndarray) -> Capsules:
        """Return the tree moved by (3,) mm."""
        return Capsules(self.starts + shift_mm, self.ends + shift_mm, self.radii)


@dataclasses.dataclass(frozen=True, eq=False)
class LabelTree:
    """A user's tree: whole, and its left and right side where the label tells them apart."""

    whole: Capsules
    sides: tuple[Capsules, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class Examination:
    """A tree and the C-arm views that it is seen from; ``h`` is the lattice's cell, mm."""

    tree: Capsules
    carms: list[CArm]
    h: float
    shape: int
    paper: bool


@dataclasses.dataclass(frozen=True, eq=False)
class TrainingScene:
    """One scene as the predictor meets it, with the truth at every candidate.

    ``views`` are (C-arm, path length in mm, calibrated) and ``hull`` is what they leave.
    """

    views: list[tuple[CArm, np.ndarray, bool]]
    hull: Candidates
    encoded: Encoded
    points_mm: np.ndarray
    spacing_mm: float
    occupancy: np.ndarray
    offset_cells: np.ndarray
    radius_cells: np.ndarray
    missed: float
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
        scene = _draw(rng, options, labels)
        if scene is not None:
            return scene
    raise RuntimeError(f"no usable scene for seed {seed}, index {i}")


def examination(
    rng: np.random.Generator,
    options: SceneOptions,
    labels: Sequence[LabelTree] = (),
    usual: bool = False,
) -> Examination | None:
    """Draw a tree and its views; None where the tree does not fit into the cube.

    With ``usual`` the views are two of those that are taken in practice, give or take some
    degrees; otherwise they are from anywhere.
    """
    paper = rng.random() < options.paper_share
    if labels and rng.random() < options.label_share:
        tree = _label_tree(rng, labels, paper)
    else:
        tree = _generated(rng, paper)
    views = 2
    if rng.random() < options.more_views_share:
        views = int(rng.integers(3, 7))
    carms, h, shape = _paper_views(rng, views) if paper else _clinical_views(rng, views)
    if usual:
        carms = _turned_to_usual(rng, carms[:2], paper)
    spread = np.maximum(np.abs(tree.starts).max(), np.abs(tree.ends).max())
    if spread > 0.5 * h * shape - 2:
        return None
    return Examination(tree, carms, h, shape, paper)


def _generated(rng: np.random.Generator, paper: bool) -> Capsules:
    tree = random_tree(rng)
    if not paper:
        tree = (
            tree.sides("left" if rng.random() < 0.65 else "right") if rng.random() < 0.8 else tree
        )
    return Capsules(*tree.segments())


def _label_tree(rng: np.random.Generator, labels: Sequence[LabelTree], paper: bool) -> Capsules:
    label = labels[int(rng.integers(len(labels)))]
    if paper or not label.sides or rng.random() > 0.8:
        return label.whole
    return label.sides[int(rng.integers(len(label.sides)))]


def _draw(
    rng: np.random.Generator, options: SceneOptions, labels: Sequence[LabelTree]
) -> TrainingScene | None:
    drawn = examination(rng, options, labels)
    if drawn is None:
        return None
    carms, h, shape, paper = drawn.carms, drawn.h, drawn.shape, drawn.paper
    tree = drawn.tree.moved(rng.uniform(-0.5, 0.5, size=3) * h)
    exact = rng.random() < options.exact_share
    misplaced = rng.random() < options.misplaced_share
    pictures = []
    for k, carm in enumerate(carms):
        true_carm = carm
        if misplaced and k:
            true_carm = carm.moved(rng.normal(size=3) * rng.uniform(0, 0.6) * h)
        path = picture(rng, true_carm, tree)
        if not exact:
            path = degrade(rng, path, h)
        pictures.append((carm, path, exact))
    grid = Grid(center_mm=(0.0, 0.0, 0.0), size_mm=(h * shape,) * 3, shape=(shape,) * 3)
    hull = visual_hull([(c, p) for c, p, _ in pictures], grid, CandidateOptions())
    if not 500 < len(hull) < MAX_POINTS:
        return None
    truth, offset, radius = occupancy(hull.points_mm, h, tree.starts, tree.ends, tree.radii)
    return TrainingScene(
        views=pictures,
        hull=hull,
        encoded=encode(hull, pictures),
        points_mm=hull.points_mm,
        spacing_mm=h,
        occupancy=truth.astype(np.float32),
        offset_cells=np.nan_to_num(offset / h).astype(np.float32),
        radius_cells=np.nan_to_num(radius / h).astype(np.float32),
        missed=0.0,
        kind=("paper" if paper else "clinical") + ("" if exact else "-degraded"),
    )


def _paper_views(rng: np.random.Generator, n: int) -> tuple[list[CArm], float, int]:
    h = rng.uniform(1.25, 1.5)
    start = rng.uniform(-180, 90) if rng.random() < 0.5 else 0.0
    step = 180.0 / n
    return (
        [
            CArm(
                primary_angle_deg=_wrap(start + k * step),
                secondary_angle_deg=0.0,
                sod_mm=1000 * h,
                sdd_mm=1500 * h,
                rows=NET_PIXELS,
                columns=NET_PIXELS,
                pixel_spacing_mm=(1.5 * h,) * 2,
            )
            for k in range(n)
        ],
        h,
        128,
    )


def _clinical_views(rng: np.random.Generator, n: int) -> tuple[list[CArm], float, int]:
    h = rng.uniform(0.85, 1.25)
    while True:
        carms = []
        for _ in range(n):
            sod = rng.uniform(700, 820)
            pixel = h * rng.uniform(0.95, 1.3)
            sdd = rng.uniform(1000, 1220)
            carms.append(
                CArm(
                    primary_angle_deg=rng.uniform(-60, 60),
                    secondary_angle_deg=rng.uniform(-35, 35),
                    sod_mm=sod,
                    sdd_mm=sdd,
                    rows=NET_PIXELS,
                    columns=NET_PIXELS,
                    pixel_spacing_mm=(pixel * sdd / sod,) * 2,
                )
            )
        if all(25 < separation_deg(a, b) < 155 for i, a in enumerate(carms) for b in carms[:i]):
            return carms, h, 128


def _turned_to_usual(rng: np.random.Generator, carms: Sequence[CArm], paper: bool) -> list[CArm]:
    """Keep distances and sizes, take the directions from ``USUAL_VIEWS``."""
    if paper:
        chosen = list(PAPER_VIEWS)
    else:
        chosen = [USUAL_VIEWS[k] for k in rng.permutation(len(USUAL_VIEWS))[: len(carms)]]
    out = []
    for carm, (primary, secondary) in zip(carms, chosen, strict=True):
        turn = rng.normal(size=2) * (0.0 if paper else USUAL_SPREAD_DEG)
        out.append(
            dataclasses.replace(
                carm, primary_angle_deg=primary + turn[0], secondary_angle_deg=secondary + turn[1]
            )
        )
    return out


def picture(rng: np.random.Generator, carm: CArm, tree: Capsules) -> np.ndarray:
    """Point-sampled rays at network size, or a finer picture averaged down to it."""
    factor = 1 if rng.random() < 0.5 else int(rng.integers(2, 5))
    fine = carm.resized(carm.rows * factor, carm.columns * factor)
    path = path_lengths(fine, tree.starts, tree.ends, tree.radii)
    if factor > 1:
        path = cv2.resize(path, (carm.columns, carm.rows), interpolation=cv2.INTER_AREA)
    return path


def degrade(rng: np.random.Generator, path: np.ndarray, h: float) -> np.ndarray:
    """Unknown contrast, blur, noise, a wandering mask, gaps: what segmentation leaves us."""
    mask = (path > 0.3 * h).astype(np.uint8)
    out = path.copy()
    if rng.random() < 0.5:
        # The calibre seen in the mask in place of the attenuation.
        width = 2 * cv2.distanceTransform(mask, cv2.DIST_L2, 3) * h
        out = out * (1 - (w := rng.uniform(0, 1))) + w * np.maximum(width - 0.5 * h, 0)
    out = cv2.GaussianBlur(out, (0, 0), rng.uniform(0.2, 0.9))
    noise: Array = cv2.GaussianBlur(
        rng.normal(size=path.shape).astype(np.float32), (0, 0), rng.uniform(0.5, 6)
    )
    noise *= rng.uniform(0, 0.3) / max(float(noise.std()), 1e-6)
    out = out * rng.uniform(0.7, 1.4) * np.exp(noise)
    out = out ** rng.uniform(0.8, 1.15)
    for _ in range(rng.poisson(1.0)):
        rows, cols = np.nonzero(mask)
        k = rng.integers(len(rows)) if len(rows) else 0
        if len(rows):
            cv2.circle(out, (int(cols[k]), int(rows[k])), int(rng.integers(1, 3)), 0.0, -1)
    out[out < rng.uniform(0.1, 0.5) * h] = 0.0
    return out.astype(np.float32)


def _wrap(angle: float) -> float:
    return (angle + 180.0) % 360.0 - 180.0
