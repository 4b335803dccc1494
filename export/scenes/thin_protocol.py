"""The set-up with thin vessels: generated left trees on fine pixels, with noise or without.

Label volumes lose what is thinner than a voxel or two, so such trees have to be generated. Their
centrelines are known exactly: what is found of them, and what is no vessel of theirs, is measured
on lines and not on voxels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity, Scene, View
from gcar_deploy.measure.metrics import Measure
from gcar_deploy.types import Points
from gcar_export.scenes.protocols import MM_PER_COUNT, Case
from gcar_export.scenes.raycast import as_label
from gcar_export.scenes.render import occupancy, path_lengths
from gcar_export.scenes.trees import random_tree, thin_style

#: protocol -> background noise of the path lengths, mm
THIN: Mapping[str, float] = {"thin-0": 0.0, "thin-0.05": 0.05, "thin-0.2": 0.2}
#: trees of the protocol, by seeds that no training scene has
TREES = 12
SEED = 770_000
#: (primary, secondary) of the views
DIRECTIONS = ((50, 25), (-50, 25))
SIDE_PX, PITCH_MM = 960, 0.184
#: how near a line counts as found, and how densely lines are sampled, mm
NEAR_MM, STEP_MM = 1.0, 0.25


def thin_names() -> list[Path]:
    """Return what stands for label volumes: names of trees that are generated from them."""
    return [Path("generated") / f"{number:02d}" for number in range(1, TREES + 1)]


def thin_case(name: str, protocol: str, views: int = 2) -> Case:
    """Simulate one case.

    Parameters
    ----------
    name : of ``thin_names``
    protocol : one of ``THIN``
    views : int, 2

    Raises
    ------
    UsageError
        Another number of views.
    """
    if views != len(DIRECTIONS):
        raise UsageError(f"views = {views}: protocol {protocol} has two views")
    rng = np.random.default_rng([SEED, int(name)])
    starts, ends, radii = random_tree(rng, thin_style(rng)).sides("left").segments()
    grid = Grid(center_mm=(0, 0, 0), size_mm=(128, 128, 128), shape=(128, 128, 128))
    carms = [
        CArm(
            primary_angle_deg=primary,
            secondary_angle_deg=secondary,
            sod_mm=750,
            sdd_mm=1000,
            rows=SIDE_PX,
            columns=SIDE_PX,
            pixel_spacing_mm=(PITCH_MM, PITCH_MM),
        )
        for primary, secondary in DIRECTIONS
    ]
    pictures = []
    for carm in carms:
        path = path_lengths(carm, starts, ends, radii)
        path = path + rng.normal(0, THIN[protocol], path.shape)
        pictures.append(np.clip(np.rint(path / MM_PER_COUNT), 0, 65535).astype(np.uint16))
    voxels = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), -1)
    filled = occupancy(grid.index2world(voxels.reshape(-1, 3)), 1.0, starts, ends, radii)[0]
    truth = filled.reshape(grid.shape).astype(np.float32)
    intensity = Intensity(kind="path_length", polarity="bright", mm_per_count=MM_PER_COUNT)
    return Case(
        name=name,
        protocol=protocol,
        scene=Scene(
            views=tuple(
                View(id=str(k + 1), carm=carm, intensity=intensity) for k, carm in enumerate(carms)
            ),
            grid=grid,
        ),
        pictures=tuple(pictures),
        label=as_label(truth, grid, name),
        truth=truth,
        new_views=(),
        line_mm=along([np.stack(pair) for pair in zip(starts, ends, strict=True)]),
    )


def along(lines: Sequence[Points]) -> Points:
    """(n, 3) points along polylines, ``STEP_MM`` apart or a little less."""
    out = [np.zeros((0, 3))]
    for line in lines:
        steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
        arc = np.concatenate([[0.0], np.cumsum(steps)])
        at = np.linspace(0.0, arc[-1], int(np.ceil(arc[-1] / STEP_MM)) + 1)
        out.append(np.stack([np.interp(at, arc, line[:, k]) for k in range(3)], axis=1))
    return np.concatenate(out)


def line_measures(truth_mm: Points, found_mm: Points | None) -> dict[str, Measure]:
    """Shares of the true line that is found, and of the found line that is true, 0 .. 1."""
    if found_mm is None or not len(found_mm):
        reason = "no prediction" if found_mm is None else "prediction is empty"
        return {"found_1mm": Measure(None, reason), "true_1mm": Measure(None, reason)}
    found = cKDTree(found_mm).query(truth_mm)[0] <= NEAR_MM
    true = cKDTree(truth_mm).query(found_mm)[0] <= NEAR_MM
    return {"found_1mm": Measure(float(found.mean())), "true_1mm": Measure(float(true.mean()))}
