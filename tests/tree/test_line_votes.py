"""Points that tell where their centreline is: closed forms, and vessels that touch."""

import dataclasses

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.tree.centerline import build_tree
from gcar_deploy.tree.line_votes import as_line_density, line_votes


def cylinders(axes, radius, length=40.0, edge=1.0, told=True):
    """Cells of parallel cylinders along z whose axes pass through (x, 0), and their offsets."""
    reach = max(map(abs, axes)) + radius + 1
    x, y, z = (np.arange(-k, k + 0.1, edge) for k in (reach, radius + 1, length / 2))
    points = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    lines = np.array([[a, 0.0] for a in axes])
    apart, nearest = cKDTree(lines).query(points[:, :2])
    inside = apart <= radius
    points, nearest = points[inside], nearest[inside]
    offset = np.zeros_like(points)
    offset[:, :2] = lines[nearest] - points[:, :2]
    return CenterPoints(
        points_mm=points, confidence=np.full(len(points), 0.8),
        radius_mm=np.full(len(points), radius), spacing_mm=edge, source="multi",
        offset_mm=offset if told else None,
    )  # fmt: skip


@pytest.mark.parametrize("radius", [1.5, 3.0])
def test_a_line_peaks_at_its_confidence_however_thick_the_vessel(radius):
    # Cells as fine as this have the cylinder's volume to some percent.
    votes = line_votes(cylinders([0.0], radius, edge=0.25))
    assert np.abs(votes.points_mm[:, :2]).max() < 1e-9
    dense = as_line_density(votes, cell_mm=0.5, smooth_cells=1.0)
    at = np.rint(dense.points_mm / 0.5).astype(int) + np.array([10, 10, 50])
    on_axis = np.isclose(dense.points_mm[:, 2] % 0.5, 0)
    raster = np.zeros((21, 21, 101))
    # Every other layer falls on the raster's: of those, both layers of a cell.
    np.add.at(raster, tuple(at[on_axis].T), 2 * dense.confidence[on_axis])
    smooth = ndimage.gaussian_filter(raster, 1.0, mode="constant")
    assert smooth[10, 10, 50] == pytest.approx(0.8, rel=0.05)


def test_vessels_that_touch_come_apart():
    touching = cylinders([-2.0, 2.0], radius=2.2)
    # Ends 4 mm apart are joined, as any are that are so near.
    lines = [p for p in build_tree(touching).points() if abs(p[2]) < 18]
    assert {round(x) for x, _, _ in lines} == {-2, 2}
    for side in (-2, 2):
        assert np.ptp([z for x, _, z in lines if abs(x - side) < 0.3]) > 34
    # Without being told, points of both are one thick vessel.
    blind = build_tree(dataclasses.replace(touching, offset_mm=None))
    assert np.abs(np.abs(blind.points()[:, 0]) - 2.0).max() > 1.0


def test_the_line_stands_where_the_points_say():
    whole = cylinders([0.0], radius=2.0)
    half = whole.select(whole.points_mm[:, 0] > 0)
    assert np.median(build_tree(half).points()[:, 0]) == pytest.approx(0.0, abs=0.05)
    blind = dataclasses.replace(half, offset_mm=None)
    assert np.median(build_tree(blind).points()[:, 0]) > 0.5


def test_offsets_that_are_not_finite_leave_points_in_place():
    whole = cylinders([0.0], radius=2.0)
    bad = whole.offset_mm.copy()
    bad[::7] = np.nan
    tree = build_tree(dataclasses.replace(whole, offset_mm=bad))
    assert np.isfinite(tree.points()).all()
    assert len(tree.branches) == 1


def test_more_than_two_views_tear_vessels_more_often():
    whole = cylinders([0.0], radius=2.0)
    torn = whole.select(np.abs(whole.points_mm[:, 2]) > 2.5)
    assert len(build_tree(torn).branches) == 2
    assert len(build_tree(torn, views=3).branches) == 1
    far = whole.select(np.abs(whole.points_mm[:, 2]) > 5.0)
    assert len(build_tree(far, views=3).branches) == 2


def test_a_box_too_large_for_finer_cells_is_worked_on_as_it_is():
    near = cylinders([0.0], radius=0.8, length=20.0, edge=0.3)
    apart = np.concatenate([near.points_mm, near.points_mm + 75.0])
    both = dataclasses.replace(
        near, points_mm=apart, confidence=np.tile(near.confidence, 2),
        radius_mm=np.tile(near.radius_mm, 2), offset_mm=np.tile(near.offset_mm, (2, 1)),
    )  # fmt: skip
    blind = build_tree(dataclasses.replace(both, offset_mm=None))
    assert len(blind.branches) == 2
    assert build_tree(both).points().tobytes() == blind.points().tobytes()
