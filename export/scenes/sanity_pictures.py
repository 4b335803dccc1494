"""Thirty generated angiograms from trivial to hard, at the sizes that real ones have.

The first ten have nothing but vessels, dark on an even ground without noise, of any contrast; the
next ten anatomy, quanta and a display; the last ten devices, collimators and JPEG as well, and
less contrast and fewer quanta.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.types import Array, Mask
from gcar_export.scenes.angiogram_vessels import Vessels, catheter
from gcar_export.scenes.raw_pictures import RawOptions, raw_picture
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.trees import SyntheticTree, random_tree

#: pictures of each of the three kinds
EACH = 10
#: sides in pixels, and fields at the isocentre in mm: pixels of 0.1 .. 0.4 mm
SIDES = (512, 640, 768, 1024)
FIELD_MM = (100.0, 200.0)
#: rays that cross at least so much vessel are vessel, mm; share of white that is lost behind the
#: deepest vessel of a trivial picture
VESSEL_MM = 0.3
DROP = (0.2, 1.0)
_SEED = 77_003


@dataclasses.dataclass(frozen=True, eq=False)
class SanityPicture:
    """One picture with its truth.

    Attributes
    ----------
    kind : str, ``trivial``, ``plain`` or ``hard``
    pixels : (side, side) uint8, vessels dark
    mask, catheter : (side, side) bool, vessels, and catheter outside them
    carm : CArm, the view
    """

    kind: str
    pixels: Array
    mask: Mask
    catheter: Mask
    carm: CArm


def sanity_picture(number: int) -> SanityPicture:
    """Picture ``number``, 0 .. 29; further ones go on with the three kinds in turn."""
    rng = np.random.default_rng([_SEED, number])
    kind = ("trivial", "plain", "hard")[number // EACH % 3]
    tree = random_tree(rng).sides("left" if rng.random() < 0.6 else "right")
    carm = _view(rng, tree)
    starts, ends, radii = tree.segments()
    path = path_lengths(carm, starts, ends, radii)
    mask = path >= VESSEL_MM
    tube = np.zeros_like(path)
    if kind == "trivial":
        pixels = _trivial(rng, path, mask)
    else:
        if kind == "hard":
            tube = _catheter(rng, tree, carm)
        pixels = _raw(rng, np.maximum(path, tube), kind)
    return SanityPicture(kind, pixels, mask, (tube >= VESSEL_MM) & ~mask, carm)


def _view(rng: np.random.Generator, tree: SyntheticTree) -> CArm:
    side = int(rng.choice(SIDES))
    spacing = float(np.exp(rng.uniform(*np.log(FIELD_MM)))) / side * 4 / 3
    carm = CArm(
        primary_angle_deg=float(rng.uniform(-50, 50)),
        secondary_angle_deg=float(rng.uniform(-30, 30)),
        sod_mm=750.0, sdd_mm=1000.0, rows=side, columns=side,
        pixel_spacing_mm=(spacing, spacing),
    )  # fmt: skip
    points = carm.project(np.concatenate([v.points_mm for v in tree.vessels]))[0]
    middle = (side - 1) - 0.5 * (points.min(axis=0) + points.max(axis=0))
    return dataclasses.replace(carm, principal_point_px=(float(middle[0]), float(middle[1])))


def _trivial(rng: np.random.Generator, path: Array, mask: Mask) -> Array:
    """Areas of one grey value, or vessels as deep as they are, on white or grey."""
    white, drop = float(rng.uniform(120, 255)), float(rng.uniform(*DROP))
    depth = mask.astype(np.float32)
    if rng.random() < 0.5:
        depth = 1 - np.exp(-0.6 * path)
    return np.rint(white * (1 - drop * depth)).astype(np.uint8)


def _catheter(rng: np.random.Generator, tree: SyntheticTree, carm: CArm) -> Array:
    """(side, side) mm of contrast in a catheter that ends where the tree begins."""
    pixel_mm = carm.pixel_at_isocenter_mm
    start = carm.project(tree.vessels[0].points_mm[:6])[0]
    step = start[-1] - start[0]
    empty = np.zeros((carm.rows, carm.columns), np.float32)
    vessels = Vessels(
        path_px=empty, doubtful=empty > 0, ostium=start[0],
        heading=step / max(float(np.hypot(*step)), 1e-9),
    )  # fmt: skip
    return np.asarray(catheter(rng, vessels, pixel_mm)[0] * np.float32(pixel_mm))


def _raw(rng: np.random.Generator, path_mm: Array, kind: str) -> Array:
    hard = kind == "hard"
    options = RawOptions(
        contrast_per_mm=float(rng.uniform(0.05, 0.1) if hard else rng.uniform(0.1, 0.3)),
        background=float(rng.uniform(0.08, 0.18) if hard else rng.uniform(0.02, 0.1)),
        photons=float(rng.uniform(300, 1500) if hard else rng.uniform(1500, 10_000)),
        gamma=float(rng.uniform(0.5, 1.2)),
        blur_px=float(rng.uniform(0.5, 1.5)),
    )
    pixels = raw_picture(path_mm, rng, options)
    if not hard:
        return pixels
    side = pixels.shape[0]
    row, col = np.indices(pixels.shape) - 0.5 * side
    if rng.random() < 0.5:
        pixels[np.hypot(row, col) > 0.56 * side] = 3
    data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, int(rng.uniform(40, 90))])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED))
