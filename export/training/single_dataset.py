"""Training pictures of the single-view predictor: path lengths in, true depth and centreline.

Views are the paper's two and six that are usual in practice: monocular depth has to be learned per
direction. Picture i of seed s is a function of (s, i) alone. Depth is that of the true cone-beam
ray: the middle of its longest stretch of vessel, at the pixel of each cell that shows most of it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gcar_deploy.predict.center_map import (
    MIN_PATH_PIXELS,
    NetPicture,
    blocks,
    encode_depth,
    net_picture,
)
from gcar_deploy.types import Array
from gcar_export.scenes.capsules import LabelTree
from gcar_export.scenes.pictures import degrade
from gcar_export.scenes.render import path_and_depth
from gcar_export.training.dataset import picture
from gcar_export.training.examinations import SceneOptions, examination
from gcar_export.training.networks.unet import UNetConfig

#: views taken of each drawn tree
VIEWS = 2
#: label-like trees as they lie in the patient, exact paths or what grey values leave of them
SCENES = SceneOptions(
    paper_share=0.45, fine_share=0.0, inputs=(0.65, 0.0, 0.35, 0.0), thin_share=0.0,
    rough_share=0.0, oval_share=0.0,
)  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class TrainingPicture:
    """One view as the predictor meets it, with the truth in every cell.

    Attributes
    ----------
    picture : NetPicture, degraded as deployment will be
    depth : (m, m) float32, 0 .. 1, where ``known``; 0 elsewhere
    known : (m, m) bool, cells that stand for vessel and truly show some
    centerline_mm : (n, 3) centreline points inside the picture, mm LPS
    kind : protocol and degradation
    """

    picture: NetPicture
    depth: np.ndarray
    known: np.ndarray
    centerline_mm: np.ndarray
    kind: str


def training_pictures(
    seed: int,
    i: int,
    config: UNetConfig,
    options: SceneOptions | None = None,
    labels: Sequence[LabelTree] = (),
) -> list[TrainingPicture]:
    """Draw tree ``i`` and its ``VIEWS`` pictures; draws again where a picture is empty."""
    options = options or SCENES
    for attempt in range(20):
        rng = np.random.default_rng([seed, i, attempt, 1])
        drawn = examination(rng, options, labels, usual=True)
        if drawn is None:
            continue
        exact = rng.random() < options.inputs[0]
        tree = drawn.tree.moved(rng.uniform(-4, 4, size=3))
        kind = drawn.regime + ("" if exact else "-degraded")
        out = []
        for carm in drawn.carms[:VIEWS]:
            path = picture(rng, carm, tree)
            if not exact:
                path = degrade(rng, path, carm.pixel_at_isocenter_mm)
            seen = net_picture(carm, path, config.pixels)
            true_path, ray_mm = path_and_depth(seen.carm, tree.starts, tree.ends, tree.radii)
            depth, known = _targets(seen, true_path, ray_mm, config.alpha)
            line = _visible(seen, 0.5 * (tree.starts + tree.ends))
            if known.sum() < 10 or not len(line):
                break
            out.append(TrainingPicture(seen, depth, known, line, kind))
        if len(out) == VIEWS:
            return out
    raise RuntimeError(f"no usable pictures for seed {seed}, index {i}")


def _targets(seen: NetPicture, true_path: Array, ray_mm: Array, alpha: int) -> tuple[Array, Array]:
    """Depth of each cell's best pixel, and which cells have one."""
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
