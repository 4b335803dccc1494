"""Pairs of pictures that do or do not show one tree, for judging the quality gates.

============ ===== =============================================================================
kind         unit  what
============ ===== =============================================================================
same               two views of one tree, placed as the geometry says
two trees          the second picture shows another patient's tree
sign               the geometry has a secondary angle (view 2's, if not 0) with the wrong sign
swapped            picture 1 is given as view 2 and the other way round
shift        mm    the patient moved by so much, in a random direction, before the second view
angle        deg   the second gantry was turned by so much, in a random direction
============ ===== =============================================================================

Left trees, the clinical views (RAO 30 CAU 20, LAO 45 CRA 25; 512 x 512 pixels), as exact path
lengths and as raw 8-bit pictures whose contrast, background and quanta are drawn for each pair.
Masks of left trees and of right ones; of generated trees in the clinical views or those of the
common protocol, clean or with a segmentation's faults. The geometry says nothing of shift and
angle, whose size is drawn as well.
"""

from __future__ import annotations

import dataclasses
import hashlib
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.measure.metrics import skeleton
from gcar_deploy.types import Array, Image, Points, Volume
from gcar_export.scenes.labels import read_label
from gcar_export.scenes.pictures import spoil
from gcar_export.scenes.protocols import (
    MASK_PATH_MM,
    MM_PER_COUNT,
    at_centroid,
    case_geometry,
    common_geometry,
)
from gcar_export.scenes.raw_pictures import RawOptions, raw_picture
from gcar_export.scenes.raycast import raycast
from gcar_export.scenes.render import occupancy, path_lengths
from gcar_export.scenes.trees import random_tree

#: of these no pair may be ``ok``: there is no tree to be had from them
WRONG = ("two trees", "sign", "swapped")
#: what pose refinement is for; judged by what comes out
OFF = ("shift", "angle")
KINDS = ("same", *WRONG, *OFF)
MASKS = {"left mask": "left", "right mask": "right"}
PICTURES = ("path length", "raw", *MASKS)
#: voxels of a label that hold so much vessel are on its centreline: of coarse labels thin vessels
#: fill none to a half, and pictures show them all the same
VESSEL_SHARE = 0.2
SHIFTS_MM = (2.0, 4.0, 6.0, 8.0, 10.0)
ANGLES_DEG = (1.0, 2.0, 3.0, 4.0, 5.0)
#: attenuation per mm, spread of the background's attenuation, quanta per pixel: see RawOptions
CONTRASTS = (0.05, 0.10, 0.15)
BACKGROUNDS = (0.07, 0.14, 0.28)
PHOTONS = (400.0, 1500.0, 5000.0)
UNITS = {"contrast": " / mm", "background": "", "photons": " per pixel"}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """One left or right coronary tree.

    Attributes
    ----------
    name : str
    side : ``left`` or ``right``
    seen : picture of a view: C-arm -> (rows, columns) path length, mm
    truth : (nx, ny, nz) occupancy on the clinical grid, which every pair's tree is asked on
    line_mm : (n, 3) points of its centreline
    generated : bool
    """

    name: str
    side: str
    seen: Callable[[CArm], Image]
    truth: Volume
    line_mm: Points
    generated: bool


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """Two pictures with the geometry they are given with.

    Attributes
    ----------
    level : mm or deg of ``shift`` and ``angle``, else 0
    raw : what the raw pictures are made of, None of others
    angiograms : both pictures
    spoilt : whether masks have a segmentation's faults
    """

    kind: str
    level: float
    raw: RawOptions | None
    angiograms: tuple[Angiogram, ...]
    spoilt: bool = False


def side_of(pictures: str) -> str:
    """Return which artery pictures of some kind show."""
    return MASKS.get(pictures, "left")


def generated_subject(seed: int, number: int, side: str = "left") -> Subject:
    """Tree ``number`` of a population of generated ones."""
    tree = random_tree(np.random.default_rng([seed, number])).sides(side)
    segments, line = tree.segments(), tree.line()
    grid = case_geometry("clinical", 2)[1]
    return Subject(
        name=str(number),
        side=side,
        seen=lambda carm: path_lengths(carm, *segments),
        truth=_voxels(grid, line, segments),
        line_mm=line,
        generated=True,
    )


def real_subject(file: Path, side: str = "left", common: bool = False) -> Subject:
    """Tree of a label volume; ``common`` puts its centroid in the isocentre, not its middle."""
    label = read_label(file)
    tree = label.left_right()[("left", "right").index(side)]
    tree = at_centroid(tree) if common else tree.centred()

    def seen(carm: CArm) -> Image:
        return raycast(tree, carm, margin_mm=float(np.linalg.norm(carm.isocenter_offset_mm)))

    grid = case_geometry("clinical", 2)[1]
    line = skeleton(tree.occupancy >= VESSEL_SHARE, tree.grid.spacing_mm)
    return Subject(
        name=label.name,
        side=side,
        seen=seen,
        truth=tree.on_grid(grid),
        line_mm=tree.grid.index2world(line.index.astype(np.float64)),
        generated=False,
    )


def make_pair(subject: Subject, other: Subject, kind: str, pictures: str, seed: int) -> Pair:
    """Simulate a pair; the same for the same arguments.

    Parameters
    ----------
    subject : whose tree view 1 shows
    other : another patient, for ``two trees``
    kind, pictures : of ``KINDS`` and ``PICTURES``
    seed : of everything drawn. Raw pictures of real trees take their anatomy from the name
        alone and are made of the defaults: ``same`` is the protocol ``raw`` of the evaluation.
    """
    rng = np.random.default_rng(
        [seed, zlib.crc32(f"{subject.name} {other.name} {kind} {pictures}".encode())]
    )
    told = _views(subject, pictures, rng)
    level, true = _second_view(told[1], kind, rng)
    paths = [subject.seen(told[0]), (other if kind == "two trees" else subject).seen(true)]
    if kind == "swapped":
        paths.reverse()
    if kind == "sign":
        # An angle of zero has no sign: then the first view's is wrong.
        wrong = 1 if told[1].secondary_angle_deg else 0
        sign = -told[wrong].secondary_angle_deg
        told[wrong] = dataclasses.replace(told[wrong], secondary_angle_deg=sign)
    if pictures == "path length":
        images = [np.rint(path / MM_PER_COUNT).astype(np.uint16) for path in paths]
        return _pair(kind, level, None, told, images)
    if pictures in MASKS:
        return _masks(subject, (kind, level), told, paths, rng)
    if subject.generated:
        raw = RawOptions(
            contrast_per_mm=float(rng.choice(CONTRASTS)),
            background=float(rng.choice(BACKGROUNDS)),
            photons=float(rng.choice(PHOTONS)),
        )
    else:
        raw, rng = RawOptions(), np.random.default_rng(zlib.crc32(subject.name.encode()))
    return _pair(kind, level, raw, told, [raw_picture(path, rng, raw) for path in paths])


def _views(subject: Subject, pictures: str, rng: np.random.Generator) -> list[CArm]:
    """Clinical views; those of the common protocol for masks of real trees, and half the others."""
    if pictures in MASKS and (not subject.generated or rng.random() < 0.5):
        return common_geometry("common-lca" if subject.side == "left" else "common-rca")[0]
    return case_geometry("clinical", 2)[0]


def _masks(
    subject: Subject,
    kind: tuple[str, float],
    told: list[CArm],
    paths: list[Image],
    rng: np.random.Generator,
) -> Pair:
    masks = [path >= MASK_PATH_MM for path in paths]
    spoilt = subject.generated and bool(rng.random() < 0.5)
    if spoilt:
        masks = [
            spoil(rng, mask, carm.pixel_at_isocenter_mm)
            for mask, carm in zip(masks, told, strict=True)
        ]
    images = [np.uint8(255) * mask for mask in masks]
    pair = _pair(*kind, None, told, images, "mask")
    return dataclasses.replace(pair, spoilt=spoilt)


def _second_view(told: CArm, kind: str, rng: np.random.Generator) -> tuple[float, CArm]:
    """Return what the second view is off by, and where it truly stands."""
    if kind == "shift":
        level, direction = float(rng.choice(SHIFTS_MM)), rng.normal(size=3)
        return level, told.moved(level * direction / np.linalg.norm(direction))
    if kind == "angle":
        level, turn = float(rng.choice(ANGLES_DEG)), rng.uniform(0, 2 * np.pi)
        return level, told.turned(float(level * np.cos(turn)), float(level * np.sin(turn)))
    return 0.0, told


_INTENSITY = {
    "path_length": Intensity(kind="path_length", polarity="bright", mm_per_count=MM_PER_COUNT),
    "raw": Intensity(kind="raw", polarity="dark"),
    "mask": Intensity(kind="mask", polarity="bright"),
}


def _pair(
    kind: str,
    level: float,
    raw: RawOptions | None,
    told: list[CArm],
    images: list[Array],
    means: str = "",
) -> Pair:
    intensity = _INTENSITY[means or ("raw" if raw else "path_length")]
    angiograms = tuple(
        Angiogram(
            view_id=str(k + 1),
            carm=carm,
            pixels=image.astype(np.float32),
            bit_depth=8 * image.dtype.itemsize,
            intensity=intensity,
            sha256=hashlib.sha256(image.tobytes()).hexdigest(),
        )
        for k, (carm, image) in enumerate(zip(told, images, strict=True))
    )
    return Pair(kind=kind, level=level, raw=raw, angiograms=angiograms)


def _voxels(grid: Grid, line: Array, segments: tuple[Array, Array, Array]) -> Volume:
    """Occupancy of the capsules, asked only of voxels near the centreline."""
    voxel = float(grid.spacing_mm[0])
    index = np.argwhere(np.ones(grid.shape, bool))
    points = grid.index2world(index)
    reach = float(segments[2].max()) + 2 * voxel
    near = np.isfinite(cKDTree(line).query(points, distance_upper_bound=reach)[0])
    out = np.zeros(grid.shape, np.float32)
    out[tuple(index[near].T)] = occupancy(points[near], voxel, *segments)[0]
    return out
