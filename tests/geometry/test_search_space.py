"""Vessels are looked for wherever all views look, unless a volume is asked for."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from skimage.morphology import skeletonize

from gcar_deploy.config import RunOptions
from gcar_deploy.errors import GeometryError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.default_grid import default_grid
from gcar_deploy.geometry.search_space import USUAL_EDGE_MM, search_spaces
from gcar_deploy.predict import seen_by_all
from gcar_deploy.predict.hull import cubic_lattice
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
def test_every_view_sees_the_middle_sphere_of_the_default_volume(seed):
    rng = np.random.default_rng(seed)
    carms = arms(rng, 2 + seed % 3)
    offset = rng.uniform(-30, 30, 3)
    for moved in ([0.0, 0.0, 0.0], offset):
        grid = default_grid([dataclasses.replace(a, isocenter_offset_mm=moved) for a in carms])
        np.testing.assert_allclose(grid.center_mm, -np.asarray(moved), atol=1e-4)
        away = rng.normal(size=(20_000, 3))
        away *= 0.5 * grid.size_mm[0] / np.linalg.norm(away, axis=1, keepdims=True)
        for one in carms:
            pixel, _ = one.project(away)
            edge = np.minimum(pixel, (one.columns - 1, one.rows - 1) - pixel)
            assert edge.min() > -0.51
    assert not grid.bounds


@pytest.mark.parametrize("cut", [(0, 400), (300, 512)])
def test_pictures_cut_beside_the_isocentre_get_a_volume_where_both_see(cut):
    """Legitimate crops: the principal point lies outside, and the heart in both."""
    whole = [carm(-45, 0, 512, 0.35), carm(45, 0, 512, 0.35)]
    first, last = cut
    crops = [
        dataclasses.replace(one, rows=last - first, principal_point_px=(255.5, 255.5 - first))
        for one in whole
    ]
    grid = default_grid(crops)
    assert grid.size_mm[0] > 45
    for one in crops:
        inside = visible(one, np.asarray([grid.center_mm]))
        assert inside.all()


def test_views_that_see_nothing_in_common_are_refused():
    here, there = two_views()
    with pytest.raises(GeometryError, match=r"view \d sees no space .* correct principal_point_px"):
        default_grid([here, dataclasses.replace(there, principal_point_px=(127.5, -900.0))])


def test_a_volume_that_is_asked_for_bounds_and_another_says_nothing_of_the_search():
    grid = default_grid(two_views())
    asked = dataclasses.replace(grid, bounds=True)
    assert search_spaces(asked, 0.5) == (asked,)
    usual, widest = search_spaces(grid, 0.5)
    assert usual.size_mm[0] < widest.size_mm[0] and not widest.bounds
    cut = default_grid(
        [dataclasses.replace(one, principal_point_px=(99.5, 12.5)) for one in two_views()]
    )
    assert cut.size_mm != grid.size_mm and search_spaces(cut, 0.5) == (usual, widest)
    for cell in (0.2, 0.3):  # the finest that can be asked for
        assert [cubic_lattice(space, cell) for space in search_spaces(grid, cell)]


def test_vessel_beside_the_default_volume_is_a_candidate():
    carms = [carm(-45, 0, 512, 0.4), carm(45, 0, 512, 0.4)]
    grid = dataclasses.replace(
        default_grid(carms), center_mm=(0.0, 0.0, 0.0), size_mm=(USUAL_EDGE_MM,) * 3
    )
    # Between the beams the field of both reaches farthest out of the cube; across the planes that
    # hold both sources a vessel has no ghosts.
    line = np.linspace((0.0, 0.0, -50.0), (95.0, 0.0, 50.0), 150)
    line = line[np.all([visible(one, line) for one in carms], axis=0)]
    assert np.abs(line[-1]).max() > USUAL_EDGE_MM / 2 + 10.0
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
