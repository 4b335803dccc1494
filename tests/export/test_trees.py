"""Generated trees: plausible numbers, the same from the same seed."""

import numpy as np
import pytest

from gcar_export.scenes.tree_curves import MURRAY
from gcar_export.scenes.trees import random_tree, rough_style, thin_style


def test_same_seed_same_tree_other_seed_other_tree():
    a, b = (random_tree(np.random.default_rng(5)) for _ in range(2))
    for x, y in zip(a.vessels, b.vessels, strict=True):
        np.testing.assert_array_equal(x.points_mm, y.points_mm)
        np.testing.assert_array_equal(x.radius_mm, y.radius_mm)
    c = random_tree(np.random.default_rng(6))
    assert not np.array_equal(a.vessels[0].points_mm, c.vessels[0].points_mm)


@pytest.mark.parametrize("seed", range(12))
def test_numbers_are_those_of_hearts(seed):
    tree = random_tree(np.random.default_rng(seed))
    starts, ends, radii = tree.segments()
    length = np.linalg.norm(ends - starts, axis=1).sum()
    box = np.ptp(np.concatenate([starts, ends]), axis=0)
    assert 250 < length < 1400
    assert (box > 40).all() and (box < 170).all()
    assert radii.min() >= 0.4 and radii.max() <= 3.4
    names = {v.name for v in tree.vessels}
    assert {"LM", "LAD", "LCx", "RCA"} <= names
    assert MURRAY == 3


@pytest.mark.parametrize("side", ["left", "right"])
def test_one_side_is_centred_and_alone(side):
    tree = random_tree(np.random.default_rng(3)).sides(side)
    assert {v.side for v in tree.vessels} == {side}
    points = np.concatenate([v.points_mm for v in tree.vessels])
    np.testing.assert_allclose(points.min(0) + points.max(0), 0, atol=1e-9)


def test_side_branches_start_on_their_tree():
    tree = random_tree(np.random.default_rng(11)).sides("left")
    trunk = np.concatenate([v.points_mm for v in tree.vessels if v.name in ("LM", "LAD", "LCx")])
    for v in tree.vessels:
        if v.name.startswith(("D", "OM", "S")) and not v.name.endswith("a"):
            assert np.linalg.norm(trunk - v.points_mm[0], axis=1).min() < 2.0


def lengths_and_radii(seed, draw):
    rng = np.random.default_rng(seed)
    starts, ends, radii = random_tree(rng, draw(rng) if draw else None).segments()
    return np.linalg.norm(ends - starts, axis=1), radii


@pytest.mark.slow
def test_thin_trees_reach_a_quarter_of_a_millimetre_and_keep_their_trunks():
    thin = [lengths_and_radii(seed, thin_style) for seed in range(20)]
    share = [length[radii < 0.5].sum() / length.sum() for length, radii in thin]
    assert 0.1 < np.mean(share) < 0.5
    assert min(radii.min() for _, radii in thin) == pytest.approx(0.22)
    assert np.mean([np.percentile(radii, 95) for _, radii in thin]) > 1.3
    usual = [lengths_and_radii(seed, None) for seed in range(20)]
    assert np.mean([r.size for _, r in thin]) > 1.15 * np.mean([r.size for _, r in usual])


def test_thin_trees_have_twice_as_many_vessels():
    def count(draw):
        drawn = [np.random.default_rng(seed) for seed in range(20)]
        return np.mean(
            [len(random_tree(rng, draw(rng) if draw else None).vessels) for rng in drawn]
        )

    assert count(thin_style) > 1.9 * count(None)


@pytest.mark.parametrize("draw", [thin_style, rough_style])
def test_branches_stay_attached_when_space_winds(draw):
    for seed in range(6):
        rng = np.random.default_rng(seed)
        tree = random_tree(rng, draw(rng)).sides("left")
        for k, v in enumerate(tree.vessels):
            others = [w.points_mm for j, w in enumerate(tree.vessels) if j != k]
            gap = np.linalg.norm(np.concatenate(others) - v.points_mm[0], axis=1).min()
            assert v.name == "LM" or gap < 2.5
