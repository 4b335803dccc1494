"""Epipolar geometry and triangulation against constructed points."""

import numpy as np
import pytest

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import (
    epipolar_lines,
    fundamental_matrix,
    plane_angles,
    plane_normal,
    ray_gaps,
    triangulate,
)


def view(a, b=0.0, **kw):
    return CArm(
        primary_angle_deg=a,
        secondary_angle_deg=b,
        sod_mm=765,
        sdd_mm=1200,
        rows=512,
        columns=512,
        pixel_spacing_mm=(0.46, 0.46),
        **kw,
    )


def test_epipolar_lines_go_through_the_point():
    pair, rng = [view(-30, -20), view(45, 25)], np.random.default_rng(1)
    X = rng.uniform(-50, 50, (60, 3))
    (a, _), (b, _) = pair[0].project(X), pair[1].project(X)
    lines = epipolar_lines(*pair, a)
    assert np.abs(np.einsum("ij,ij->i", lines, np.column_stack([b, np.ones(60)]))).max() < 1e-8
    F = fundamental_matrix(*pair)
    assert abs(np.linalg.det(F)) < 1e-9
    np.testing.assert_allclose(
        plane_angles(*pair, pair[0], a), plane_angles(*pair, pair[1], b), atol=1e-12
    )


@pytest.mark.parametrize("count", [2, 3, 4, 8])
def test_triangulation_of_exact_pixels(count):
    carms = [view(-60 + 20 * k, 25 * (-1) ** k, detector_rotation_deg=7 * k) for k in range(count)]
    X = np.random.default_rng(count).uniform(-60, 60, (40, 3))
    found, residual = triangulate(carms, [c.project(X)[0] for c in carms])
    np.testing.assert_allclose(found, X, atol=1e-8)
    assert residual.max() < 1e-8


def test_residual_is_the_distance_from_the_rays():
    """Two rays that pass each other at 3 mm: the point lies half-way, 1.5 mm from both."""
    pair = [view(0), view(90)]
    pixels = [c.project(np.array([[0.0, 0, z]]))[0] for c, z in zip(pair, (1.5, -1.5), strict=True)]
    found, residual = triangulate(pair, pixels)
    np.testing.assert_allclose(found, 0, atol=0.01)
    assert residual[0] == pytest.approx(1.5, abs=0.01)


def test_isocentre_lies_in_plane_zero_and_the_normal_is_across_it():
    pair = [view(-30, -20), view(45, 25)]
    normal = plane_normal(*pair)
    for carm in pair:
        assert abs(normal @ carm.axes[2]) < 1e-12
        at = plane_angles(*pair, carm, carm.project(np.array([[0.0, 0, 0], 5 * normal]))[0])
        assert abs(at[0]) < 1e-12 and abs(at[1]) > 1e-3


def test_rays_of_one_point_meet_and_a_move_along_the_normal_parts_them():
    first, second = view(-30, -20), view(45, 25)
    points = np.array([[0.0, 0, 0], [20, -10, 30], [-30, 25, -5]])
    a, b = (v.project(points)[0] for v in (first, second))
    np.testing.assert_allclose(ray_gaps(first, second, a, b), 0, atol=1e-9)
    normal = plane_normal(first, second)
    moved = second.moved(2.0 * normal).project(points)[0]
    # The rays at the isocentre part by the move itself; elsewhere by its share of the normal.
    assert abs(ray_gaps(first, second, a, moved)[0]) == pytest.approx(2.0, abs=0.02)
    within = np.cross(normal, second.axes[2])
    silent = second.moved(2.0 * within).project(points)[0]
    assert abs(ray_gaps(first, second, a, silent)[0]) < 1e-6
    assert ray_gaps(first, second, a[:0], a[:0]).shape == (0,)
