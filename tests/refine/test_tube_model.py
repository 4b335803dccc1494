import dataclasses

import numpy as np
import pytest

from gcar_deploy.refine.tube_model import box_chord, footprint, tubes_of
from gcar_deploy.tree.tree import Tree
from tests.refine.scenes import carm, two_views
from tests.tree.shapes import branch, fork, tube


def test_box_chord_is_the_mean_chord_over_the_box():
    r, box = 1.3, 0.6
    for rho in np.linspace(0, 1.8, 19):
        x = np.linspace(rho - box / 2, rho + box / 2, 20001)
        slow = np.mean(2 * np.sqrt(np.maximum(r * r - x * x, 0)))
        fast = box_chord(np.array([rho]), np.array([r]), box)[0][0]
        assert fast == pytest.approx(slow, abs=2e-4)


def test_box_chord_derivatives():
    rng = np.random.default_rng(0)
    rho, r = rng.uniform(0, 1.6, 200), rng.uniform(0.4, 2, 200)
    _, by_rho, by_r = box_chord(rho, r, 0.5)
    h = 1e-6
    num = (box_chord(rho + h, r, 0.5)[0] - box_chord(rho - h, r, 0.5)[0]) / (2 * h)
    np.testing.assert_allclose(by_rho, num, atol=2e-4)
    num = (box_chord(rho, r + h, 0.5)[0] - box_chord(rho, r - h, 0.5)[0]) / (2 * h)
    np.testing.assert_allclose(by_r, num, atol=2e-4)


@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 1, 0.3), (0.2, -1, 0.6)])
def test_projected_mass_is_the_volume(axis):
    tree = tube(length=40, radius=1.4, count=51, axis=axis)
    view = carm(20, 15)
    seen = footprint(tubes_of(tree), view, 1.0)
    depth = view.sod_mm
    area = (0.5 * depth / view.sdd_mm) ** 2
    volume = np.pi * 1.4**2 * 40 + 4 / 3 * np.pi * 1.4**3
    assert seen.image((256, 256)).sum() * area == pytest.approx(volume, rel=0.03)


def test_joined_tubes_are_a_union_not_a_sum():
    line = np.stack([np.linspace(-15, 15, 31), np.zeros(31), np.zeros(31)], 1)
    one = Tree(nodes_mm=line[[0, -1]], branches=(branch(line, 1.5),))
    twice = Tree(nodes_mm=line[[0, -1]], branches=(branch(line, 1.5), branch(line, 1.5)))
    view = carm(0, 0)
    a = footprint(tubes_of(one), view, 1.0).image((256, 256))
    b = footprint(tubes_of(twice), view, 1.0).image((256, 256))
    np.testing.assert_allclose(a, b, atol=1e-9)


def test_tubes_at_different_depth_add_up():
    line = np.stack([np.linspace(-15, 15, 31), np.zeros(31), np.zeros(31)], 1)
    other = line + np.array([0, 20.0, 0])
    both = Tree(
        nodes_mm=np.concatenate([line[[0, -1]], other[[0, -1]]]),
        branches=(branch(line, 1.5), branch(other, 1.5, 2, 3)),
    )
    picture = footprint(tubes_of(both), carm(0, 0), 1.0).image((256, 256))
    assert picture.max() == pytest.approx(6.0, abs=0.1)


def test_pairs_kept_from_before_give_the_same_picture():
    tubes, view = tubes_of(fork()), carm(30, 20)
    first = footprint(tubes, view, 1.0)
    moved = dataclasses.replace(
        tubes, positions_mm=tubes.positions_mm + 0.1, log_radius=tubes.log_radius + 0.05
    )
    fresh = footprint(moved, view, 1.0)
    kept = footprint(moved, view, 1.0, first.pairing)
    assert kept.pairing is first.pairing
    np.testing.assert_allclose(kept.image((256, 256)), fresh.image((256, 256)), atol=1e-12)
    far = dataclasses.replace(tubes, positions_mm=tubes.positions_mm + 3.0)
    assert footprint(far, view, 1.0, first.pairing).pairing is not first.pairing


def test_behind_the_source_and_outside_the_picture_is_empty():
    for shift in ([0, 5000.0, 0], [900.0, 0, 0]):
        tree = tube()
        moved = Tree(
            nodes_mm=tree.nodes_mm + shift,
            branches=(branch(tree.branches[0].points_mm + shift, 1.5),),
        )
        for view in (carm(0, 0), *two_views()):
            picture = footprint(tubes_of(moved), view, 1.0).image((256, 256))
            assert np.isfinite(picture).all()
