"""The implicit network and the FBP start, on the small tree of the other baselines."""

import numpy as np
import pytest

from gcar_deploy.measure.metrics import best_dice
from gcar_export.methods.fbp_gaussians import fbp_centers
from gcar_export.methods.nerp import NerpOptions, nerp, ray_matrix, seen_voxels
from gcar_export.scenes.raycast import raycast
from tests.export.test_baselines import GRID, carm, pictures, tree  # noqa: F401

SMALL = NerpOptions(features=32, width=32, hidden_layers=2, steps=120, bandwidth=5.0)


@pytest.mark.slow
@pytest.mark.parametrize("view", [carm(-30, -20), carm(45, 25, detector_rotation_deg=15)])
def test_rays_through_voxels_agree_with_the_ray_caster(tree, view):  # noqa: F811
    voxels = np.argwhere(tree.occupancy > 0)
    made = (ray_matrix(view, GRID, voxels) @ np.ones(len(voxels))).reshape(96, 96)
    cast = raycast(tree, view)
    assert np.abs(made - cast).mean() < 0.03 * cast[cast > 0].mean()
    assert made.sum() == pytest.approx(cast.sum(), rel=5e-3)


def test_voxels_that_a_view_rules_out_are_not_asked(tree):  # noqa: F811
    seen = np.zeros(GRID.shape, bool)
    seen[tuple(seen_voxels(*pictures(tree, 2), GRID, 0.1).T)] = True
    assert seen[tree.occupancy > 0].mean() > 0.99
    assert seen.mean() < 0.1
    blank = [np.zeros((96, 96), np.float32)] * 2, pictures(tree, 2)[1]
    assert not nerp(*blank, GRID).any()


@pytest.mark.slow
def test_network_finds_the_tree_and_the_same_one_again(tree):  # noqa: F811
    losses = []
    found = nerp(*pictures(tree, 6), GRID, SMALL, lambda step, loss, volume: losses.append(loss))
    assert best_dice(tree.occupancy, found)[0].value > 0.7
    assert losses[-1] < 0.2 * losses[0]
    assert np.array_equal(found, nerp(*pictures(tree, 6), GRID, SMALL))


def test_steps_end_when_the_loss_no_longer_falls(tree):  # noqa: F811
    import dataclasses

    losses = []
    options = dataclasses.replace(SMALL, patience=3, tolerance=0.9, width=8, features=4)
    nerp(*pictures(tree, 2), GRID, options, lambda step, loss, volume: losses.append(loss))
    assert 4 <= len(losses) < options.steps
    assert min(losses[-3:]) > 0.1 * min(losses[:-3])


def test_fbp_start_takes_the_brightest_voxels_and_holds_the_vessels_volume(tree):  # noqa: F811
    given = pictures(tree, 2)
    volume = 0.1 * tree.occupancy
    volume[0, 0, 0] = 0.01
    filled = int((tree.occupancy > 0).sum())
    centers = fbp_centers(volume, GRID, *given, count=filled)
    assert len(centers) == filled
    inside = GRID.world2index(centers.points_mm).round().astype(int)
    assert tree.occupancy[tuple(inside.T)].all()
    # A tree off the isocentre is seen at another magnification: a few per cent.
    assert centers.confidence.sum() == pytest.approx(tree.occupancy.sum(), rel=0.1)
    assert len(fbp_centers(np.zeros(GRID.shape), GRID, *given, count=5)) == 0
