"""The analytic renderer against closed forms and against brute force."""

import numpy as np
import pytest

from gcar_deploy.geometry.carm import CArm
from gcar_export.scenes.render import occupancy, path_lengths

CARM = CArm(
    primary_angle_deg=30,
    secondary_angle_deg=-20,
    sod_mm=750,
    sdd_mm=1100,
    rows=96,
    columns=128,
    pixel_spacing_mm=(1.2, 0.9),
)


def rays_of(carm):
    cols, rows = np.meshgrid(np.arange(carm.columns), np.arange(carm.rows))
    return carm.rays(np.column_stack([cols.ravel(), rows.ravel()]))


def test_sphere_has_the_chord_of_a_sphere():
    centre, radius = np.array([[4.0, -7.0, 9.0]]), 6.0
    image = path_lengths(CARM, centre, centre, np.array([radius]))
    rays = rays_of(CARM)
    w = centre[0] - CARM.source_mm
    rho = np.linalg.norm(np.cross(rays, w), axis=1)
    chord = 2 * np.sqrt(np.clip(radius**2 - rho**2, 0, None))
    np.testing.assert_allclose(image.ravel(), chord, atol=2e-4)


def test_overlapping_capsules_count_once():
    a = np.array([[0.0, 0, -20], [0.0, 0, -20], [0.0, 0, 0]])
    b = np.array([[0.0, 0, 20], [0.0, 0, 5], [0.0, 0, 20]])
    r = np.array([3.0, 3.0, 3.0])
    np.testing.assert_allclose(
        path_lengths(CARM, a, b, r), path_lengths(CARM, a[:1], b[:1], r[:1]), atol=2e-4
    )


def test_union_against_fine_ray_marching():
    rng = np.random.default_rng(0)
    a = rng.uniform(-20, 20, (12, 3))
    b = a + rng.uniform(-15, 15, (12, 3))
    r = rng.uniform(0.8, 3.0, 12)
    image = path_lengths(CARM, a, b, r).ravel()
    picked = np.flatnonzero(image > 0)[::23]
    rays, t = rays_of(CARM)[picked], np.arange(660.0, 840.0, 0.01)
    for k, ray in zip(picked, rays, strict=True):
        p = CARM.source_mm + t[:, None] * ray
        inside = np.zeros(len(t), bool)
        for i in range(len(r)):
            u = b[i] - a[i]
            s = np.clip((p - a[i]) @ u / (u @ u), 0, 1)
            inside |= np.linalg.norm(p - a[i] - s[:, None] * u, axis=1) < r[i]
        assert image[k] == pytest.approx(inside.sum() * 0.01, abs=0.06)


def test_occupancy_of_a_sphere_adds_up_to_its_volume():
    axis = np.arange(-8, 8) + 0.5
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    centre = np.array([[0.3, -0.2, 0.1]])
    share, offset, radius = occupancy(points, 1.0, centre, centre, np.array([5.0]), sub=6)
    assert share.sum() == pytest.approx(4 / 3 * np.pi * 125, rel=5e-3)
    near = np.isfinite(radius)
    np.testing.assert_allclose(
        points[near] + offset[near], np.repeat(centre, near.sum(), 0), atol=1e-9
    )


def test_nothing_in_sight_is_zero():
    far = np.array([[500.0, 0, 0]])
    assert path_lengths(CARM, far, far, np.array([1.0])).sum() == 0
