"""The raster's filters, distances and neighbours against SciPy's own."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree

from gcar_deploy.tree.raster import blurred, depth_of, hysteresis, peaks, splat, touching

SHAPE = (17, 22, 13)


def blobs(seed=0, reach=3.0):
    """Vessel-like mask with four empty cells all round."""
    noise = np.random.default_rng(seed).normal(size=SHAPE)
    smooth = ndimage.gaussian_filter(noise, reach / 2)
    mask = smooth > np.quantile(smooth, 0.8)
    inner = np.zeros(SHAPE, bool)
    inner[4:-4, 4:-4, 4:-4] = True
    return mask & inner


@pytest.mark.parametrize(("sigma", "truncate"), [(0.6, 3.0), (1.5, 2.0)])
def test_smoothing_is_gaussian(sigma, truncate):
    volume = np.where(blobs(), np.random.default_rng(1).random(SHAPE), 0.0)
    slow = ndimage.gaussian_filter(volume, sigma, truncate=truncate, mode="constant")
    assert np.abs(blurred(volume, sigma, truncate) - slow).max() < 1e-6


def test_peaks_are_the_highest_within_two_cells():
    volume = np.random.default_rng(2).random(SHAPE).astype(np.float32)
    cells = np.argwhere(volume >= 0)
    found = peaks(volume, cells).reshape(SHAPE)
    assert np.array_equal(found, ndimage.maximum_filter(volume, size=5))


@pytest.mark.parametrize("reach", [2.0, 8.0])
def test_depth_is_the_distance_to_the_nearest_empty_cell(reach):
    mask = blobs(3, reach)
    slow = ndimage.distance_transform_edt(mask)
    cells = np.argwhere(mask)
    assert np.allclose(depth_of(cells, mask), slow[tuple(cells.T)])


def test_touching_cells_are_the_26_neighbours():
    cells = np.argwhere(blobs(4))
    pairs, length = touching(cells, SHAPE)
    slow = cKDTree(cells).query_pairs(1.8)
    assert {tuple(sorted(p)) for p in pairs.tolist()} == slow and len(pairs) == len(slow)
    assert np.allclose(length, np.linalg.norm(cells[pairs[:, 0]] - cells[pairs[:, 1]], axis=1))


def test_deposit_keeps_mass_and_centre():
    at = np.random.default_rng(5).uniform(2, 10, (50, 3))
    weight = np.random.default_rng(6).random(50)
    raster = splat(at, weight, np.array(SHAPE))
    assert raster.sum() == pytest.approx(weight.sum())
    index = np.stack(np.indices(SHAPE), -1)
    mean = (raster[..., None] * index).sum(axis=(0, 1, 2)) / raster.sum()
    assert np.allclose(mean, (weight[:, None] * at).sum(axis=0) / weight.sum())


def test_weak_cells_stay_only_beside_strong_ones():
    value = np.zeros(SHAPE)
    value[5, 5, 5:9] = [0.1, 0.1, 0.3, 0.1]
    value[10, 5, 5:9] = 0.1
    mask = hysteresis(value, 0.08, 0.25)
    assert mask[5, 5, 5:9].all() and mask.sum() == 4
