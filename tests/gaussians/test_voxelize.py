"""Occupancy keeps mass whatever the voxels; density control keeps it whatever it does."""

import numpy as np
import pytest

from gcar_deploy.gaussians.density_control import clone, most_wanting, prune, split
from gcar_deploy.gaussians.voxelize import voxelize
from gcar_deploy.geometry.grid import Grid
from tests.gaussians.test_project import random_gaussians

BLOCKS = [
    Grid(center_mm=(0, 0, 0), size_mm=(80, 80, 80), shape=(80, 80, 80)),
    Grid(center_mm=(1, 2, 3), size_mm=(81, 81, 81), shape=(27, 27, 27)),
    Grid(center_mm=(0, 0, 0), size_mm=(60, 60, 90), shape=(200, 200, 30)),
]


@pytest.mark.parametrize("grid", BLOCKS, ids=["1 mm", "3 mm", "0.3 x 0.3 x 3 mm"])
@pytest.mark.parametrize("sigma", [(0.05, 0.06), (0.5, 2.0)])
def test_mass_is_kept(grid, sigma):
    g = random_gaussians(15, 1, spread=12, sigma=sigma)
    mass = voxelize(g, grid).sum(dtype=np.float64) * np.prod(grid.spacing_mm)
    assert mass == pytest.approx(g.masses_mm3().sum(), rel=1e-5)


def test_value_is_the_density_where_voxels_are_small():
    g = random_gaussians(6, 2, spread=8, sigma=(2.0, 4.0))
    grid = Grid(center_mm=(0, 0, 0), size_mm=(40, 40, 40), shape=(80, 80, 80))
    volume = voxelize(g, grid)
    index = np.random.default_rng(0).integers(0, 80, (200, 3))
    d = grid.index2world(index)[:, None] - g.means_mm
    q = np.einsum("vni,nij,vnj->vn", d, np.linalg.inv(g.covariances()), d)
    want = (g.intensity * np.exp(-0.5 * q)).sum(axis=1)
    np.testing.assert_allclose(volume[tuple(index.T)], want, atol=0.02)


def test_outside_and_none():
    grid = BLOCKS[0]
    assert voxelize(random_gaussians(0), grid).sum() == 0
    g = random_gaussians(3, spread=1)
    far = type(g)(
        means_mm=g.means_mm + 500,
        scales_mm=g.scales_mm,
        quaternions_wxyz=g.quaternions_wxyz,
        intensity=g.intensity,
    )
    assert voxelize(far, grid).sum() == 0


def test_clone_and_split_keep_mass_and_centre():
    g = random_gaussians(10, 3)
    chosen = np.array([1, 4, 9])
    pull = np.array([[1e-9, 2e-9, 0], [0, 0, 0], [3.0, -1, 5]])
    for out in (clone(g, chosen, pull), split(g, chosen)):
        assert len(out) == 13
        # Twins in one place would have equal gradients and never part.
        assert np.linalg.norm(out.means_mm[chosen] - out.means_mm[10:], axis=1).min() > 0.1
        m0, m1 = g.masses_mm3(), out.masses_mm3()
        assert m1.sum() == pytest.approx(m0.sum(), rel=1e-12)
        np.testing.assert_allclose(m1 @ out.means_mm, m0 @ g.means_mm, atol=1e-8)
    out = split(g, chosen)
    # The second moment along the split axis is kept as well.
    for k, i in enumerate(chosen):
        pair = out.select(np.array([i, 10 + k]))
        centre = pair.means_mm.mean(axis=0)
        d = pair.means_mm - centre
        moment = (pair.covariances() + d[:, :, None] * d[:, None, :]).mean(axis=0)
        np.testing.assert_allclose(moment, g.covariances()[i], atol=1e-10)


def test_prune_counts_its_reasons_and_cap_holds():
    g = random_gaussians(10, 4)
    kept, reasons = prune(g, np.median(g.masses_mm3()), np.array([[-20.0] * 3, [20.0] * 3]))
    assert reasons["light"] == 5 and len(kept) == 10 - sum(reasons.values())
    pull = np.array([5.0, 1, 9, 9, 2])
    assert most_wanting(pull, 1.5, 3).tolist() == [0, 2, 3]
    assert most_wanting(pull, 1.5, 0).tolist() == []
