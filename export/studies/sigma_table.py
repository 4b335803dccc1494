"""Is the stated sigma true? Generated trees, geometry off by the stated prior, error over sigma.

Every view after the first is turned and moved by draws from the prior that sigma includes
(``geometry.prior.LEFT_DEG``, ``LEFT_MM``); the reconstruction is told nothing of it. For each
centreline point, e is its distance from the true centreline and sigma the stated standard
deviation in the worst direction across the vessel. Points further than ``GHOST_MM`` from any
vessel are ghosts: no sigma speaks of them, and their share stands beside.

Sigma has three parts, added in quadrature: what the fit's own equations say, the prior on the
geometry, and the pixel's share. ``calibrate_parts`` leaves them out one by one.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
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
from gcar_deploy.result import Result
from gcar_deploy.tree.curves import resample
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.fit import PIXEL_SHARE
from gcar_deploy.tubes.uncertainty import geometry_sigma
from gcar_deploy.types import Array
from gcar_export.scenes.protocols import MM_PER_COUNT, case_geometry
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.trees import SyntheticTree, random_tree

#: further off than this is another vessel or none, mm
GHOST_MM = 5.0
#: share of 95 % of a Gaussian, standard deviations
Z95 = 1.96
CONDITIONS = ("clean", "degraded")
#: what sigma is made of, part after part; the last is the sigma that a result states
PARTS = ("fit alone", "fit, geometry", "fit, geometry, pixel")
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
    mean_z2 : mean of (e / sigma)^2, 1 where sigma is right
    coverage : share of points with e <= 1.96 sigma
    rmse_mm, sigma_mm : root mean squares of e and of sigma
    ghosts : share of points further than ``GHOST_MM`` from any vessel, left out above
    refused : trees
    """

    protocol: str
    condition: str
    predictor: str
    parts: str
    trees: int
    points: int
    mean_z2: float
    coverage: float
    rmse_mm: float
    sigma_mm: float
    ghosts: float
    refused: int


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
) -> list[Calibration]:
    """Compare errors with sigma made of more and more of its parts, one cell per ``PARTS``.

    Parameters
    ----------
    protocol : ``paper`` or ``clinical``
    condition : ``clean`` or ``degraded`` (noise on the path lengths)
    predictor : ``multi`` or ``none``
    seed : of the trees; another seed is another population
    trees : how many
    """
    options = RunOptions()
    options = dataclasses.replace(
        options,
        predict=dataclasses.replace(options.predict, predictor=cast(PredictorName, predictor)),
    )
    engine = Engine(options=options)
    errors, sigmas, refused = [], [], 0
    for k in range(trees):
        rng = np.random.default_rng([seed, k])
        tree = random_tree(rng)
        tree = tree.sides("left") if protocol == "clinical" else tree
        carms, grid = case_geometry(protocol, 2)
        pictures = _pictures(tree, carms, rng, condition)
        try:
            result = engine.reconstruct(pictures, grid)
        except GcarError:
            refused += 1
        else:
            errors.append(point_errors(result.tree, tree)[0])
            sigmas.append(sigma_parts(result))
        if on_tree is not None:
            on_tree()
    e = np.concatenate([np.zeros(0), *errors])
    near = e < GHOST_MM
    cells = []
    for parts, sigma in zip(
        PARTS, np.concatenate([np.zeros((3, 0)), *sigmas], axis=1), strict=True
    ):
        z = e[near] / sigma[near]
        cells.append(
            Calibration(
                protocol=protocol,
                condition=condition,
                predictor=predictor,
                parts=parts,
                trees=trees,
                points=int(near.sum()),
                mean_z2=float(np.mean(z**2)) if len(z) else float("nan"),
                coverage=float(np.mean(z <= Z95)) if len(z) else float("nan"),
                rmse_mm=float(np.sqrt(np.mean(e[near] ** 2))) if len(z) else float("nan"),
                sigma_mm=float(np.sqrt(np.mean(sigma[near] ** 2))) if len(z) else float("nan"),
                ghosts=float(np.mean(~near)) if len(e) else float("nan"),
                refused=refused,
            )
        )
    return cells


def sigma_parts(result: Result) -> Array:
    """(3, n) sigma of each centreline point, mm, made of more and more of ``PARTS``.

    What the result states is taken apart: geometry and pixel are worked out again, and what they
    leave is the fit's.
    """
    carms = [view.carm for view in result.views]
    stated = np.concatenate([branch.sigma_mm for branch in result.tree.branches])
    geometry = geometry_sigma(result.tree.points(), carms)
    pixel = PIXEL_SHARE * max(carm.pixel_at_isocenter_mm for carm in carms)
    fit = np.sqrt(np.maximum(stated**2 - geometry**2 - pixel**2, 0.0))
    return np.stack([fit, np.hypot(fit, geometry), stated])


def point_errors(made: Tree, truth: SyntheticTree) -> tuple[Array, Array]:
    """(n,) distance of each centreline point from the true centreline, and its sigma, mm."""
    dense = np.concatenate([resample(v.points_mm, 0.1) for v in truth.vessels])
    error = cKDTree(dense).query(made.points())[0]
    return error, np.concatenate([b.sigma_mm for b in made.branches])


def table(rows: Sequence[Calibration]) -> str:
    """Markdown."""
    lines = [
        "| set-up | pictures | predictor | sigma of | trees | points | mean z^2 "
        "| within 1.96 sigma % | RMSE mm | sigma mm | ghosts % |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        used = f"{r.trees - r.refused} of {r.trees}" if r.refused else f"{r.trees}"
        lines.append(
            f"| {r.protocol} | {r.condition} | {r.predictor} | {r.parts} | {used} | {r.points} "
            f"| {r.mean_z2:.2f} | {100 * r.coverage:.1f} | {r.rmse_mm:.2f} | {r.sigma_mm:.2f} "
            f"| {100 * r.ghosts:.1f} |"
        )
    return "\n".join(lines)


def _pictures(
    tree: SyntheticTree,
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
        path = path_lengths(true, *tree.segments())
        if condition == "degraded":
            noise = rng.normal(0.0, 1.0, path.shape) * (NOISE_MM + NOISE_SHARE * path)
            path = np.where(path > 0.3, np.maximum(path + noise, 0.0), 0.0)
        counts = np.rint(path / MM_PER_COUNT).astype(np.float32)
        out.append(
            Angiogram(
                view_id=str(number + 1),
                carm=carm,
                pixels=counts,
                bit_depth=16,
                intensity=Intensity(
                    kind="path_length", polarity="bright", mm_per_count=MM_PER_COUNT
                ),
                sha256=hashlib.sha256(counts.tobytes()).hexdigest(),
            )
        )
    return out
