"""Vessels are looked for wherever all views look, unless a volume is asked for."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from skimage.morphology import skeletonize

from gcar_deploy.config import RunOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.common_field import FARTHEST_MM, common_field
from gcar_deploy.geometry.scene import default_grid
from gcar_deploy.predict import seen_by_all
from gcar_deploy.tree.edit import with_branch
from gcar_deploy.tree.tree import empty_tree
from tests.tubes.scenes import carm, seen, two_views


def arms(rng: np.random.Generator, count: int) -> list[CArm]:
    out = []
    for primary in rng.uniform(-60, 60) + 180.0 / count * np.arange(count):
        pixel = rng.uniform(0.15, 0.4)
        rows, columns = rng.integers(300, 700, 2).tolist()
        out.append(CArm(
            primary_angle_deg=primary, secondary_angle_deg=rng.uniform(-40, 40),
            sod_mm=rng.uniform(700, 850), sdd_mm=rng.uniform(950, 1250), rows=rows,
            columns=columns, pixel_spacing_mm=(pixel, pixel),
        ))  # fmt: skip
    return out


def visible(arm: CArm, points: np.ndarray) -> np.ndarray:
    """Whether points fall into the picture."""
    pixel, _ = arm.project(points)
    return ((pixel > 0) & (pixel < (arm.columns - 1, arm.rows - 1))).all(axis=1)


@pytest.mark.parametrize("seed", range(6))
def test_all_that_every_view_sees_is_in_the_box(seed):
    rng = np.random.default_rng(seed)
    carms = arms(rng, 2 + seed % 3)
    grid = default_grid(carms)
    box = common_field(grid, carms)
    points = rng.uniform(-FARTHEST_MM, FARTHEST_MM, (60_000, 3))
    both = np.all([visible(one, points) for one in carms], axis=0)
    inside = (np.abs(points - box.center_mm) <= np.asarray(box.size_mm) / 2).all(axis=1)
    cube = (np.abs(points - grid.center_mm) <= np.asarray(grid.size_mm) / 2).all(axis=1)
    assert both.sum() > 300 and inside[both].all() and inside[cube].all()
    assert (both & ~cube).any()
    # It is a box round them, not the whole room.
    reach = np.abs(points[both] - box.center_mm).max(axis=0) + 10.0
    assert (
        np.asarray(box.size_mm) / 2 <= np.maximum(reach, np.asarray(grid.size_mm) / 2 + 1)
    ).all()


def test_a_picture_cut_near_the_central_ray_makes_no_room_of_too_many_voxels():
    whole = two_views()
    carms = [dataclasses.replace(one, principal_point_px=(9.5, 12.5)) for one in whole]
    grid = default_grid(carms)
    assert grid.spacing_mm[0] < 0.1
    box = common_field(grid, carms)
    assert np.min(box.size_mm) > 50 > grid.size_mm[0]


def test_a_volume_that_is_asked_for_bounds():
    carms = two_views()
    grid = default_grid(carms)
    asked = dataclasses.replace(grid, bounds=True)
    assert not grid.bounds and common_field(asked, carms) is asked


def test_vessel_beside_the_default_volume_is_a_candidate():
    carms = [carm(-45, 0, 256, 0.4), carm(45, 0, 256, 0.4)]
    grid = default_grid(carms)
    half = grid.size_mm[0] / 2
    # Between the beams the field of both reaches farthest out of the cube; across the planes that
    # hold both sources a vessel has no ghosts.
    line = np.linspace((0.0, 0.0, -30.0), (60.0, 0.0, 30.0), 90)
    line = line[np.all([visible(one, line) for one in carms], axis=0)]
    assert np.abs(line[-1]).max() > half + 10.0
    views = [
        dataclasses.replace(view, skeleton=skeletonize(view.mask))
        for view in seen(with_branch(empty_tree(), line, 1.2, 1.0, 0.5), carms)
    ]
    tip = line[-6:]

    def reached(of):
        points = seen_by_all(views, of, RunOptions()).hull.points_mm
        return np.linalg.norm(points[:, None] - tip, axis=2).min() < 1.5

    assert reached(grid) and not reached(dataclasses.replace(grid, bounds=True))
    # What points in the cube explain is not looked for beside it: there are ghosts out there.
    views = [dataclasses.replace(view, skeleton=np.zeros_like(view.skeleton)) for view in views]
    assert not reached(grid)
    # Nor what no point anywhere explains.
    views[0].skeleton[5:60, 9] = True
    assert not reached(grid)
