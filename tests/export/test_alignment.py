"""Rigid alignment: a motion that was made is found again, a mirror image is not explained away."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

pytest.importorskip("torch", reason="needs the export extra")

from gcar_deploy.tree.surface import lumen_surface, stl_bytes
from gcar_export.evaluate.alignment import align, best_rotation, read_stl, sample_surface
from tests.tree.shapes import fork, tube


def surface_points(count=3000, seed=0):
    surface = lumen_surface(fork(), 0.6)
    return sample_surface(surface.vertices_mm, surface.faces, count, seed)


def test_point_by_point():
    rng = np.random.default_rng(0)
    a = rng.normal(size=(20, 3))
    R = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    found, shift = best_rotation(a, a @ R.T + [1, 2, 3])
    np.testing.assert_allclose(found, R, atol=1e-12)
    np.testing.assert_allclose(shift, [1, 2, 3], atol=1e-12)
    mirrored, _ = best_rotation(a, a * [-1, 1, 1])
    assert np.linalg.det(mirrored) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_any_motion_is_found_again(seed):
    rng = np.random.default_rng(seed)
    R = Rotation.random(rng=rng).as_matrix()
    fixed = surface_points(1500, seed=1) @ R.T + rng.uniform(-300, 300, 3)
    moving = surface_points(400)
    found = align(moving, fixed)
    gap = cKDTree(fixed).query(found.apply(moving))[0]
    assert np.median(gap) < 0.6 and np.linalg.det(found.rotation) == pytest.approx(1.0)
    turned = np.degrees(np.arccos((np.trace(found.rotation @ R.T) - 1) / 2))
    assert turned < 2.0


@pytest.mark.slow
def test_a_mirror_image_does_not_fit():
    fixed, moving = surface_points(6000, seed=1), surface_points(400)
    assert align(moving * [-1, 1, 1], fixed).cost_mm > 2 * align(moving, fixed).cost_mm


def test_samples_lie_on_the_surface_evenly():
    surface = lumen_surface(tube(length=30, radius=2.0), 0.5)
    points = sample_surface(surface.vertices_mm, surface.faces, 4000)
    middle = points[np.abs(points[:, 2]) < 10]
    np.testing.assert_allclose(np.hypot(middle[:, 0], middle[:, 1]), 2.0, atol=0.15)
    assert np.histogram(middle[:, 2], 10)[0].std() < 40


def test_stl_round_trip():
    surface = lumen_surface(tube(), 0.6)
    corners, faces = read_stl(stl_bytes(surface))
    assert len(faces) == len(surface.faces)
    np.testing.assert_allclose(corners[faces], surface.vertices_mm[surface.faces], atol=1e-4)
    with pytest.raises(ValueError, match="STL"):
        read_stl(b"solid nothing")
