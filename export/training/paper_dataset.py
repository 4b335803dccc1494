"""Training pictures of the paper's predictor: path lengths in, true depth and vessel points.

The set-up is the paper's: two fixed views a quarter turn apart, 128 x 128 path lengths of a cube
of 128^3 voxels, whole trees as they lie in a CT volume. Generated trees are turned, scaled and
shifted further than patients differ, so that real ones lie within. Each drawn tree is used in
``POSES`` attitudes, since drawing one costs more than its pictures. Pictures i of seed s are a
function of (s, i) alone.

Depth is that of the true cone-beam ray: the middle of its longest stretch of vessel, at the pixel
of each cell that shows most of it. With ``usual`` the views are of those that are usual in
practice instead, for a network that is told the pose.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.predict.center_map import (
    MIN_PATH_PIXELS,
    NetPicture,
    blocks,
    encode_depth,
    net_picture,
)
from gcar_deploy.types import Array, Image, Points
from gcar_export.scenes.capsules import Capsules, LabelTree
from gcar_export.scenes.protocols import case_geometry
from gcar_export.scenes.render import path_and_depth
from gcar_export.scenes.trees import TreeStyle, random_tree, rough_style
from gcar_export.training.examinations import SceneOptions, examination
from gcar_export.training.networks.unet import UNetConfig

#: views taken of each tree
VIEWS = 2
#: attitudes that each generated tree is used in
POSES = 3
#: beside what the generator draws: SD of the turn about each axis, range of scale and calibre,
#: largest shift along each axis
TURN_SD_DEG = 9.0
SCALES = (0.88, 1.12)
CALIBRES = (0.85, 1.3)
SHIFT_MM = 5.0
#: trees must keep so far from the faces of the paper's cube, mm
MARGIN_MM = 2.0
#: vessel points per tree, spread evenly over the lumen
POINTS = 1024
#: share of trees that are a label volume's, where some are given
LABEL_SHARE = 0.5
#: exact pictures; the rest is blurred and its contrast wanders
EXACT_SHARE = 0.5
#: clinical views of label-like trees
USUAL_SCENES = SceneOptions(
    paper_share=0.0, fine_share=0.0, inputs=(1.0, 0.0, 0.0, 0.0), thin_share=0.0,
    rough_share=0.5, oval_share=0.0,
)  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class TrainingPicture:
    """One view as the predictor meets it, with the truth in every cell.

    Attributes
    ----------
    picture : NetPicture
    depth : (m, m) float32, 0 .. 1, where ``known``; 0 elsewhere
    known : (m, m) bool, cells that stand for vessel and truly show some
    points_mm : (n, 3) points of the lumen inside the picture, mm LPS
    centerline_mm : (n, 3) centreline points inside the picture, mm LPS
    kind : which view
    """

    picture: NetPicture
    depth: np.ndarray
    known: np.ndarray
    points_mm: Points
    centerline_mm: Points
    kind: str


def training_pictures(
    seed: int,
    i: int,
    config: UNetConfig,
    labels: Sequence[LabelTree] = (),
    usual: bool = False,
) -> list[TrainingPicture]:
    """Draw the ``VIEWS`` pictures of scene ``i``; draws again where a picture is empty."""
    for attempt in range(20):
        rng = np.random.default_rng([seed, i, attempt, 1])
        drawn = _usual(rng, labels) if usual else _paper(rng, seed, i, attempt, labels)
        if drawn is None:
            continue
        tree, carms, kinds = drawn
        points = lumen_points(rng, tree, POINTS)
        out = []
        for carm, kind in zip(carms, kinds, strict=True):
            shown = _picture(rng, carm, tree, points, config, kind)
            if shown is None:
                break
            out.append(shown)
        if len(out) == VIEWS:
            return out
    raise RuntimeError(f"no usable pictures for seed {seed}, index {i}")


def lumen_points(rng: np.random.Generator, tree: Capsules, count: int) -> Points:
    """(count, 3) points spread evenly over the lumen of a tree, mm LPS."""
    along = tree.ends - tree.starts
    share = np.linalg.norm(along, axis=1) * tree.radii**2
    k = rng.choice(len(share), size=count, p=share / share.sum())
    off = rng.normal(size=(count, 3))
    off *= (rng.random(count) ** (1 / 3) / np.linalg.norm(off, axis=1))[:, None]
    points: Points = tree.starts[k] + rng.random((count, 1)) * along[k] + off * tree.radii[k, None]
    return points


def _paper(
    rng: np.random.Generator, seed: int, i: int, attempt: int, labels: Sequence[LabelTree]
) -> tuple[Capsules, Sequence[CArm], Sequence[str]] | None:
    if labels and rng.random() < LABEL_SHARE:
        tree = labels[int(rng.integers(len(labels)))].whole
    else:
        tree = _generated(seed, i // POSES, attempt)
    turn = Rotation.from_rotvec(np.deg2rad(TURN_SD_DEG) * rng.normal(size=3)).as_matrix()
    scale, calibre = rng.uniform(*SCALES), rng.uniform(*CALIBRES)
    tree = tree.turned(scale * turn)
    # Volumes are centred on the box of their tree, so the turned one is centred anew.
    ends = np.concatenate([tree.starts, tree.ends])
    middle = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
    tree = tree.moved(rng.uniform(-SHIFT_MM, SHIFT_MM, size=3) - middle)
    carms, grid = case_geometry("paper", VIEWS)
    if tree.reach_mm > 0.5 * float(min(grid.size_mm)) - MARGIN_MM:
        return None
    tree = dataclasses.replace(tree, radii=scale * calibre * tree.radii)
    return tree, carms, [f"view {k + 1}" for k in range(VIEWS)]


@functools.lru_cache(maxsize=16)
def _generated(seed: int, number: int, attempt: int) -> Capsules:
    rng = np.random.default_rng([seed, number, attempt, 2])
    style = rough_style(rng) if rng.random() < 0.5 else TreeStyle()
    return Capsules(*random_tree(rng, style).segments())


def _usual(
    rng: np.random.Generator, labels: Sequence[LabelTree]
) -> tuple[Capsules, Sequence[CArm], Sequence[str]] | None:
    drawn = examination(rng, USUAL_SCENES, labels, usual=True)
    if drawn is None:
        return None
    return drawn.tree, drawn.carms[:VIEWS], ["usual views"] * VIEWS


def _picture(
    rng: np.random.Generator, carm: CArm, tree: Capsules, points: Points, config: UNetConfig,
    kind: str,
) -> TrainingPicture | None:  # fmt: skip
    """One view; None where it shows next to nothing."""
    empty = np.zeros((carm.rows, carm.columns), np.float32)
    seen = net_picture(carm, empty, config.pixels)
    path, ray_mm = path_and_depth(seen.carm, tree.starts, tree.ends, tree.radii)
    shown = path if rng.random() < EXACT_SHARE else _worn(rng, path, seen.pixel_mm)
    seen = dataclasses.replace(seen, path_mm=shown)
    depth, known = targets(seen, path, ray_mm, config.alpha)
    line = _visible(seen, 0.5 * (tree.starts + tree.ends))
    visible = _visible(seen, points)
    if known.sum() < 10 or not len(line) or not len(visible):
        return None
    return TrainingPicture(seen, depth, known, visible, line, kind)


def _worn(rng: np.random.Generator, path: Image, pixel_mm: float) -> Image:
    """Blur by part of a pixel, contrast that wanders by a tenth: voxelised trees look so."""
    wave = cv2.GaussianBlur(rng.normal(size=path.shape).astype(np.float32), (0, 0), 2.0)
    wave = wave * (rng.uniform(0, 0.2) / max(float(wave.std()), 1e-6))
    out = cv2.GaussianBlur(path * np.exp(wave), (0, 0), rng.uniform(0.2, 0.6))
    out[out < 0.05 * pixel_mm] = 0.0
    return np.asarray(out, dtype=np.float32)


def targets(seen: NetPicture, true_path: Array, ray_mm: Array, alpha: int) -> tuple[Array, Array]:
    """Depth of each cell's best pixel, and which cells have one, (m, m) each.

    Parameters
    ----------
    seen : NetPicture
    true_path, ray_mm : (n, n) from ``path_and_depth`` on the pixels of ``seen``
    alpha : int
    """
    path = blocks(true_path, alpha)
    best = path.argmax(axis=2)[:, :, None]
    depth = np.take_along_axis(blocks(ray_mm, alpha), best, axis=2)[:, :, 0]
    enough = np.take_along_axis(path, best, axis=2)[:, :, 0] > 0.2 * MIN_PATH_PIXELS * seen.pixel_mm
    known = seen.cells(alpha) & enough & np.isfinite(depth)
    depth = np.where(known, encode_depth(np.where(known, depth, 0.0), seen), 0.0)
    return np.clip(depth, 0.0, 1.0).astype(np.float32), known


def _visible(seen: NetPicture, points: Array) -> Array:
    pixels, depth = seen.carm.project(points)
    n = seen.carm.rows
    inside = (pixels > -0.5).all(axis=1) & (pixels < n - 0.5).all(axis=1) & (depth > 0)
    return points[inside]
