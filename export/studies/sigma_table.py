"""Is the stated sigma true? Trees with the geometry off by the stated prior, error over sigma.

Generated trees or those of label volumes. Every view after the first is turned and moved by draws
from the prior that sigma includes (``geometry.prior.LEFT_DEG``, ``LEFT_MM``); the reconstruction is
told nothing of it. For each centreline point, e is its way to the true centreline and C the stated
covariance across the vessel, two axes: z^2 = e^T C^-1 e / 2. Points further than ``GHOST_MM`` from
any vessel are ghosts: no covariance speaks of them, so they are left out of one mean and counted in
another. What a user is told to rely on is a figure of its own: results that are ``ok``, in
stretches that are not called probable ghosts; there every point counts, ghosts that nobody called
among them.

The covariance has two parts that add: what the fit leaves open, and what the geometry does.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.config import PredictorName, RunOptions
from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.prior import LEFT_DEG, LEFT_MM
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.measure.metrics import VOLUME_THRESHOLD, skeleton
from gcar_deploy.quality import PROBABLE
from gcar_deploy.quality.status import OK
from gcar_deploy.result import Result
from gcar_deploy.tree.curves import resample
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Image, Mask, Points
from gcar_export.scenes.labels import read_label
from gcar_export.scenes.protocols import MASK_PATH_MM, MM_PER_COUNT, case_geometry
from gcar_export.scenes.raw_pictures import raw_picture
from gcar_export.scenes.raycast import raycast
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.trees import random_tree

#: further off than this is another vessel or none, mm
GHOST_MM = 5.0
#: squared length that 95 % of a standard Gaussian in two dimensions stay within, per axis
CHI95 = 5.991 / 2
#: what the covariance is made of, part after part; the last is what a result states
PARTS = ("fit alone", "fit, geometry")
#: how well the centreline of a label volume is known, standard deviation per axis in voxels
LABEL_LINE = 0.6
#: noise of degraded pictures: share of the path, and mm
NOISE_SHARE, NOISE_MM = 0.08, 0.15


@dataclasses.dataclass(frozen=True, kw_only=True)
class Calibration:
    """Errors of all points of one cell against their sigma.

    Attributes
    ----------
    protocol, condition, predictor : what the cell is
    parts : of sigma that are in it, one of ``PARTS``
    trees, points : how many went in; ``refused`` trees did not
    mean_z2 : mean of z^2 per axis, 1 where the covariance is right
    mean_z2_all : the same with ghosts counted
    coverage : share of points within the ellipse that 95 % should be in
    rmse_mm, sigma_mm : root mean squares of e and of sigma
    ghosts : share of points further than ``GHOST_MM`` from any vessel, left out above
    refused : trees
    called : results that are ``ok``
    called_z2, called_coverage : of their points in stretches that are not called probable ghosts,
        whatever these points truly are
    """

    protocol: str
    condition: str
    predictor: str
    parts: str
    trees: int
    points: int
    mean_z2: float
    mean_z2_all: float
    coverage: float
    rmse_mm: float
    sigma_mm: float
    ghosts: float
    refused: int
    called: int
    called_z2: float
    called_coverage: float


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Patient:
    """Whose tree the pictures show.

    Attributes
    ----------
    seen : picture of a view: C-arm -> (rows, columns) path length, mm
    line_mm : (n, 3) points of the true centreline, dense
    line_sd_mm : how well that is known, standard deviation per axis
    """

    seen: Callable[[CArm], Image]
    line_mm: Points
    line_sd_mm: float = 0.0


def generated_patient(protocol: str, rng: np.random.Generator) -> Patient:
    """Draw a tree; in the clinical protocol its left side."""
    tree = random_tree(rng)
    tree = tree.sides("left") if protocol == "clinical" else tree
    segments = tree.segments()
    return Patient(
        seen=lambda carm: path_lengths(carm, *segments),
        line_mm=np.concatenate([resample(v.points_mm, 0.1) for v in tree.vessels]),
    )


def real_patient(protocol: str, file: Path) -> Patient:
    """Read a label volume; in the clinical protocol its left side."""
    label = read_label(file)
    tree = (label.left_right()[0] if protocol == "clinical" else label).centred()
    voxel = float(tree.grid.spacing_mm[0])
    line = skeleton(tree.occupancy >= VOLUME_THRESHOLD, tree.grid.spacing_mm)

    def seen(carm: CArm) -> Image:
        return raycast(tree, carm, margin_mm=float(np.linalg.norm(carm.isocenter_offset_mm)))

    return Patient(
        seen=seen,
        line_mm=tree.grid.index2world(line.index.astype(np.float64)),
        line_sd_mm=LABEL_LINE * voxel,
    )  # fmt: skip


def calibrate(
    protocol: str,
    condition: str,
    predictor: str,
    *,
    seed: int,
    trees: int,
    on_tree: Callable[[], None] | None = None,
) -> Calibration:
    """Reconstruct generated trees and compare errors with the sigma that the results state.

    Parameters and raises as for ``calibrate_parts``, whose last cell this is.
    """
    return calibrate_parts(protocol, condition, predictor, seed=seed, trees=trees, on_tree=on_tree)[
        -1
    ]


def calibrate_parts(
    protocol: str,
    condition: str,
    predictor: str,
    *,
    seed: int,
    trees: int,
    on_tree: Callable[[], None] | None = None,
    files: Sequence[Path] = (),
) -> list[Calibration]:
    """Compare errors with sigma made of more and more of its parts, one cell per ``PARTS``.

    Parameters
    ----------
    protocol : ``paper`` or ``clinical``
    condition : ``clean``, ``degraded`` (noise on the path lengths), ``mask`` or ``raw``
    predictor : ``multi`` or ``none``
    seed : of the trees; another seed is another population
    trees : how many
    files : label volumes, whose trees are taken instead
    """
    options = RunOptions()
    options = dataclasses.replace(
        options,
        predict=dataclasses.replace(options.predict, predictor=cast(PredictorName, predictor)),
    )
    engine = Engine(options=options)
    judged, called, refused, oks = [], [np.zeros(0, bool)], 0, 0
    for k in range(len(files) or trees):
        rng = np.random.default_rng([seed, k])
        patient = real_patient(protocol, files[k]) if files else generated_patient(protocol, rng)
        carms, grid = case_geometry(protocol, 2)
        pictures = _pictures(patient, carms, rng, condition)
        try:
            result = engine.reconstruct(pictures, grid)
        except GcarError:
            refused += 1
        else:
            judged.append(judged_points(result.tree, patient))
            called.append(relied_on(result))
            oks += result.quality.status == OK
        if on_tree is not None:
            on_tree()
    e = np.concatenate([np.zeros(0), *(of_tree[0] for of_tree in judged)])
    near, relied = e < GHOST_MM, np.concatenate(called)
    cells = []
    for k, parts in enumerate(PARTS):
        z2 = np.concatenate([np.zeros(0), *(of_tree[1][k] for of_tree in judged)])
        sigma = np.concatenate([np.zeros(0), *(of_tree[2][k] for of_tree in judged)])
        cells.append(
            Calibration(
                protocol=protocol,
                condition=condition,
                predictor=predictor,
                parts=parts,
                trees=len(files) or trees,
                points=int(near.sum()),
                mean_z2=_mean(z2[near]),
                mean_z2_all=_mean(z2),
                coverage=_mean(z2[near] <= CHI95),
                rmse_mm=_mean(e[near] ** 2) ** 0.5,
                sigma_mm=_mean(sigma[near] ** 2) ** 0.5,
                ghosts=_mean(~near),
                refused=refused,
                called=oks,
                called_z2=_mean(z2[relied]),
                called_coverage=_mean(z2[relied] <= CHI95),
            )
        )
    return cells


def _mean(values: Array) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def relied_on(result: Result) -> Mask:
    """(n,) whether a point is of an ``ok`` result and of a stretch not called a probable ghost."""
    ghosts = result.quality.ghosts
    if result.quality.status != OK or ghosts is None:
        return np.zeros(len(result.tree.points()), bool)
    return np.concatenate(ghosts.points) < PROBABLE


def judged_points(made: Tree, truth: Patient) -> tuple[Array, Array, Array]:
    """Compare the points of a tree with the true centreline.

    Returns
    -------
    error : (n,) distance, mm
    z2 : (2, n) z^2 per axis against more and more of ``PARTS``
    sigma : (2, n) worst direction of those, mm
    """
    points = made.points()
    error, nearest = cKDTree(truth.line_mm).query(points)
    tangents = np.concatenate([branch.tangents for branch in made.branches])
    across = np.eye(3) - tangents[:, :, None] * tangents[:, None, :]
    off = points - truth.line_mm[nearest]
    # The voxels of a label's line lie off along the vessel as well, which is no error.
    off = np.einsum("nij,nj->ni", across, off) if truth.line_sd_mm else off
    each = [b.covariance_mm2 for b in made.branches if b.covariance_mm2 is not None]
    covariance = np.cumsum(np.concatenate(each), axis=1)
    covariance = covariance + truth.line_sd_mm**2 * across[:, None]
    inverse = np.linalg.pinv(covariance, rcond=1e-6, hermitian=True)
    z2 = np.einsum("ni,npij,nj->pn", off, inverse, off) / 2
    return error, z2, np.sqrt(np.linalg.eigvalsh(covariance)[..., -1]).T


def table(rows: Sequence[Calibration]) -> str:
    """Markdown."""
    lines = [
        "| set-up | pictures | predictor | sigma of | trees | points | mean z^2 "
        "| within the 95 % ellipse % | RMSE mm | sigma mm | ghosts % | mean z^2 with them "
        "| `ok` | mean z^2 of their stretches not called ghosts | within 95 % |",
        "|---" * 15 + "|",
    ]
    for r in rows:
        used = f"{r.trees - r.refused} of {r.trees}" if r.refused else f"{r.trees}"
        lines.append(
            f"| {r.protocol} | {r.condition} | {r.predictor} | {r.parts} | {used} | {r.points} "
            f"| {r.mean_z2:.2f} | {100 * r.coverage:.1f} | {r.rmse_mm:.2f} | {r.sigma_mm:.2f} "
            f"| {100 * r.ghosts:.1f} | {r.mean_z2_all:.2f} | {r.called} "
            f"| {r.called_z2:.2f} | {100 * r.called_coverage:.1f} |"
        )
    return "\n".join(lines)


def _pictures(
    patient: Patient,
    told: Sequence[CArm],
    rng: np.random.Generator,
    condition: str,
) -> list[Angiogram]:
    """Pictures by views that are off by the prior, with the geometry as it is told."""
    out = []
    for number, carm in enumerate(told):
        true = carm
        if number:
            primary, secondary = rng.normal(0.0, LEFT_DEG, 2)
            true = carm.turned(float(primary), float(secondary))
            true = true.moved(rng.normal(0.0, LEFT_MM, 3))
        path = patient.seen(true)
        if condition == "degraded":
            noise = rng.normal(0.0, 1.0, path.shape) * (NOISE_MM + NOISE_SHARE * path)
            path = np.where(path > 0.3, np.maximum(path + noise, 0.0), 0.0)
        counts, depth = np.rint(path / MM_PER_COUNT).astype(np.float32), 16
        intensity = Intensity(kind="path_length", polarity="bright", mm_per_count=MM_PER_COUNT)
        if condition == "mask":
            counts, depth = 255 * (path > MASK_PATH_MM).astype(np.float32), 8
            intensity = Intensity(kind="mask", polarity="bright", mm_per_count=None)
        if condition == "raw":
            counts, depth = raw_picture(path, rng).astype(np.float32), 8
            intensity = Intensity(kind="raw", polarity="dark", mm_per_count=None)
        out.append(
            Angiogram(
                view_id=str(number + 1),
                carm=carm,
                pixels=counts,
                bit_depth=depth,
                intensity=intensity,
                sha256=hashlib.sha256(counts.tobytes()).hexdigest(),
            )
        )
    return out
