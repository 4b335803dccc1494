"""RTK sees the world as CArm does, and the baselines find a simple tree again."""

import numpy as np
import pytest

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.measure.metrics import best_dice
from gcar_export.methods.visual_hull import visual_hull
from gcar_export.scenes.labels import LabelVolume
from gcar_export.scenes.raycast import raycast

GRID = Grid(center_mm=(0, 0, 0), size_mm=(64, 64, 64), shape=(64, 64, 64))


@pytest.fixture(scope="module")
def tree():
    """Bent tube with a side branch, nothing symmetric about it, in 1 mm voxels."""
    t = np.linspace(0, 1, 200)[:, None]
    main = np.hstack([10 + 35 * t, 12 + 30 * t**2, 8 + 45 * t])
    side = np.hstack([25 + 5 * t, 18 + 35 * t, 30 - 18 * t])
    occupancy = np.zeros(GRID.shape, np.float32)
    voxels = np.indices(GRID.shape).reshape(3, -1).T
    for line in (main, side):
        low, high = line.min(0) - 3, line.max(0) + 3
        near = voxels[((voxels >= low) & (voxels <= high)).all(1)]
        gap = np.linalg.norm(near[:, None] - line[None, ::4], axis=2).min(1)
        occupancy[tuple(near[gap <= 2.0].T)] = 1
    return LabelVolume(occupancy=occupancy, grid=GRID)


def carm(primary, secondary=0.0, **more):
    settings = {"sdd_mm": 1100, "pixel_spacing_mm": (1.5, 1.5), **more}
    return CArm(
        primary_angle_deg=primary, secondary_angle_deg=secondary, sod_mm=765, rows=96, columns=96,
        **settings,
    )  # fmt: skip


def pictures(tree, views):
    carms = [carm(k * 180 / views) for k in range(views)]
    return [raycast(tree, c) for c in carms], carms


@pytest.mark.slow
def test_visual_hull_contains_the_tree_and_shrinks_with_views(tree):
    hulls = [visual_hull(*pictures(tree, n), GRID) for n in (2, 8)]
    assert (hulls[0] >= hulls[1]).mean() > 0.999
    for hull in hulls:
        assert hull[tree.occupancy > 0].mean() > 0.9
    assert hulls[1].sum() < 0.7 * hulls[0].sum()


@pytest.mark.slow
def test_rtk_projects_as_the_ray_caster_does(tree):
    pytest.importorskip("itk")
    from gcar_export.methods.rtk_geometry import forward

    carms = [
        carm(-30, -20),
        carm(45, 25, sdd_mm=1060, pixel_spacing_mm=(1.3, 1.3), detector_rotation_deg=15),
        carm(10, 5, principal_point_px=(44.0, 52.0), isocenter_offset_mm=(3, -4, 5)),
    ]
    for view, projected in zip(carms, forward(tree.occupancy, GRID, carms), strict=True):
        cast = raycast(tree, view)
        assert np.corrcoef(cast.ravel(), projected.ravel())[0, 1] > 0.995
        assert projected.sum() == pytest.approx(cast.sum(), rel=5e-3)


@pytest.mark.slow
def test_volume_passes_through_rtk_unchanged(tree):
    pytest.importorskip("itk")
    from gcar_export.methods.rtk_geometry import volume_array, volume_image

    grid = Grid(center_mm=(1, 2, 3), size_mm=(5, 12, 21), shape=(5, 6, 7))
    volume = np.random.default_rng(0).random(grid.shape).astype(np.float32)
    assert np.array_equal(volume_array(volume_image(volume, grid)), volume)


@pytest.mark.slow
@pytest.mark.parametrize(("method", "least"), [("fdk", 0.75), ("sart", 0.85)])
def test_sixteen_views_are_enough(tree, method, least):
    pytest.importorskip("itk")
    import importlib

    solve = getattr(importlib.import_module(f"gcar_export.methods.{method}"), method)
    found = solve(*pictures(tree, 16), GRID)
    assert found.min() >= 0
    assert found.max() <= 1
    assert best_dice(tree.occupancy, found)[0].value > least
