"""Real angiograms with the vessels as an expert drew them: folds, and crops to train on.

A folder holds ``N.png`` with ``N_gt.png``. What an expert draws has no depth and no catheter: the
chord is that of round vessels as wide as drawn, and nothing is asked of devices.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from gcar_deploy.errors import ImageError
from gcar_deploy.imaging.mask_path import mask_path
from gcar_deploy.imaging.net import SIDE as NETWORK_SIDE
from gcar_deploy.imaging.read import read_picture
from gcar_deploy.types import Array, Image, Mask
from gcar_export.scenes.angiograms import SIDE, network_input

#: pixels of a crop for one of the picture at the network's size
ZOOM = (0.75, 1.6)
#: of ten crops this many lie straight; the others are turned by up to so much
STRAIGHT, TURN_DEG = 4, 40.0


@dataclasses.dataclass(frozen=True, eq=False)
class ExpertPicture:
    """One real angiogram.

    Attributes
    ----------
    name : str
    pixels : (rows, cols) float32, grey values, vessels dark
    mask : (rows, cols) bool, vessels as drawn
    path_px : (rows, cols) float32, chords of round vessels as wide, pixel edges
    """

    name: str
    pixels: Image
    mask: Mask
    path_px: Image


def expert_pictures(folder: Path) -> tuple[ExpertPicture, ...]:
    """Read a folder's pictures, in the order of their numbers.

    Raises
    ------
    ImageError
        No picture with a mask of the same size.
    """
    paths = sorted(folder.glob("*_gt.png"), key=lambda p: (len(p.name), p.name))
    found = []
    for path in paths:
        name = path.name.removesuffix("_gt.png")
        pixels, mask = read_picture(path.with_name(f"{name}.png"))[0], read_picture(path)[0] > 127
        if pixels.shape != mask.shape:
            raise ImageError(f"{path}: {mask.shape} pixels, but its picture has {pixels.shape}")
        found.append(ExpertPicture(name, pixels, mask, mask_path(mask, 1.0)))
    if not found:
        raise ImageError(f"{folder}: no N.png with N_gt.png")
    return tuple(found)


def fold_edges(count: int, of: int) -> Array:
    """(of + 1,) int: where each of ``of`` runs of neighbours begins, and the end of the last."""
    return np.linspace(0, count, of + 1).round().astype(int)


def folds(
    pictures: Sequence[ExpertPicture], number: int, of: int
) -> tuple[tuple[ExpertPicture, ...], tuple[ExpertPicture, ...]]:
    """Return what fold ``number`` (1 .. ``of``) trains on, and what it leaves out.

    Folds are runs of neighbours: frames of one patient stand beside each other.
    """
    edges = fold_edges(len(pictures), of)
    low, high = edges[number - 1], edges[number]
    return tuple(pictures[:low]) + tuple(pictures[high:]), tuple(pictures[low:high])


def expert_pair(pictures: Sequence[ExpertPicture], seed: int, index: int) -> tuple[Array, Array]:
    """Return the network's input and truth of a crop, as ``angiograms.training_pair`` does.

    The picture is turned, flipped, zoomed, shifted, its grey values bent, blurred and made noisy.
    """
    rng = np.random.default_rng([seed, index, 3])
    chosen = pictures[int(rng.integers(len(pictures)))]
    move, zoom = _placed(rng, chosen.mask.shape)
    size = (SIDE, SIDE)
    pixels = cv2.warpAffine(
        chosen.pixels, move, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101
    )
    mask, path, inside = (
        cv2.warpAffine(np.asarray(a, np.float32), move, size, flags=cv2.INTER_LINEAR)
        for a in (chosen.mask, chosen.path_px * np.float32(zoom), np.ones_like(chosen.pixels))
    )
    channels, holes = network_input(_regraded(rng, np.asarray(pixels, np.float32)))
    asked = (inside > 0.99) & ~holes
    truth = np.stack([mask >= 0.5, asked, path * asked, 0 * path, 0 * path])
    return channels, np.ascontiguousarray(truth, dtype=np.float32)


def _placed(rng: np.random.Generator, shape: tuple[int, ...]) -> tuple[Array, float]:
    """(2, 3) affine map from the picture to the crop, and its enlargement."""
    rows, columns = shape
    zoom = float(np.exp(rng.uniform(*np.log(ZOOM)))) * NETWORK_SIDE / np.sqrt(rows * columns)
    turned = rng.integers(10) >= STRAIGHT
    angle = np.radians(rng.uniform(-TURN_DEG, TURN_DEG) if turned else 0.0)
    linear = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) * zoom
    linear[:, 0] *= rng.choice([-1, 1])
    linear[:, 1] *= rng.choice([-1, 1])
    if rng.integers(2):
        linear = linear[:, ::-1]
    # The crop lies within the picture as far as it can.
    free = np.maximum(np.array([columns, rows]) - SIDE / zoom, 0.0) / 2
    middle = np.array([columns - 1, rows - 1]) / 2 + rng.uniform(-1, 1, 2) * free
    offset = (SIDE - 1) / 2 - linear @ middle
    return np.column_stack([linear, offset]), zoom


def _regraded(rng: np.random.Generator, pixels: Image) -> Image:
    """Bend the grey values, blur or sharpen, add noise, at times through JPEG."""
    top = max(float(pixels.max()), 1.0)
    out = (np.clip(pixels, 0, None) / np.float32(top)) ** np.float32(np.exp(rng.normal(0, 0.3)))
    if rng.random() < 0.5:
        wide = cv2.GaussianBlur(out, (0, 0), rng.uniform(0.5, 3.0))
        out = out + np.float32(rng.uniform(-0.7, 1.0)) * (out - wide)
    if rng.random() < 0.5:
        out = out + rng.normal(0, rng.uniform(0.003, 0.025), out.shape).astype(np.float32)
    low, high = rng.uniform(0, 50), rng.uniform(180, 255)
    grey = np.clip(low + (high - low) * out, 0, 255).round().astype(np.uint8)
    if rng.random() < 0.2:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.uniform(40, 95))]
        grey = cv2.imdecode(cv2.imencode(".jpg", grey, quality)[1], cv2.IMREAD_UNCHANGED)
    return np.asarray(grey, dtype=np.float32)
