"""More views must not cost vessels: what a few of many views fail to show, and views alike."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree

from gcar_deploy.config import TubeOptions
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.fit import fit_tubes
from gcar_deploy.tubes.model import footprint, tubes_of
from gcar_deploy.tubes.support import least_seen, supported_tree
from gcar_deploy.tubes.volume import SAME_DIRECTION_DEG, _alike, tube_volume
from tests.tree.shapes import branch, fork, grid, points_of
from tests.tubes.scenes import carm, seen, two_views, vessel_image

OPTIONS = TubeOptions()


@pytest.mark.parametrize(
    ("views", "rank"), [(1, 0), (2, 0), (3, 0), (4, 1), (7, 1), (8, 2), (16, 4)]
)
def test_least_seen_leaves_a_quarter_of_the_views_out(views, rank):
    shares = np.random.default_rng(views).random((views, 50))
    np.testing.assert_array_equal(least_seen(shares), np.sort(shares, axis=0)[rank])


def test_views_that_say_nothing_are_not_counted():
    shares = np.full((8, 3), np.nan)
    shares[:2, 0] = 0.3, 0.7  # two views tell: the least of two
    shares[3:7, 1] = 0.1, 0.5, 0.6, 0.9  # four tell: one may fail
    np.testing.assert_array_equal(least_seen(shares), [0.3, 0.5, 1.0])


@pytest.mark.parametrize(
    ("views", "failing", "stays"), [(2, 1, False), (8, 2, True), (8, 3, False), (16, 4, True)]
)
def test_a_branch_stays_while_few_views_fail_to_show_it(views, failing, stays):
    tree = fork()
    tubes = tubes_of(tree)
    share = np.ones((views, len(tubes.first)))
    share[:failing, tubes.branch == 1] = 0.0
    tip = tree.nodes_mm[2]
    kept = supported_tree(tree, tubes, share)
    assert (cKDTree(kept.points()).query(tip)[0] < 1.0) == stays


def _around(count):
    return [carm(180.0 / count * k, 10.0 * (-1) ** k) for k in range(count)]


def test_a_vessel_that_one_of_eight_views_lacks_is_kept():
    truth, where = fork(), grid(64)
    views = seen(truth, _around(8))
    trunk_and_right = Tree(nodes_mm=truth.nodes_mm, branches=truth.branches[::2])
    views[3] = seen(trunk_and_right, [views[3].carm])[0]
    tree = fit_tubes(points_of(truth, where), views, OPTIONS).tree
    assert cKDTree(tree.points()).query(truth.nodes_mm[2:])[0].max() < 4.0


def test_views_alike_are_counted():
    def count(*directions):
        return _alike([vessel_image(carm(*d, size=8), np.zeros((8, 8))) for d in directions])

    assert len(count()) == 0
    np.testing.assert_allclose(count((0, 0), (90, 0)), 1.0, rtol=1e-9)
    np.testing.assert_allclose(count((20, 10), (20, 10), (110, 0)), [2, 2, 1], rtol=1e-6)
    np.testing.assert_allclose(count((0, 0), (180, 0)), 2.0, rtol=1e-9)  # from behind
    step = 11.25
    folded = np.minimum(step * np.arange(16), 180 - step * np.arange(16))
    expected = np.exp(-0.5 * (folded / SAME_DIRECTION_DEG) ** 2).sum()
    np.testing.assert_allclose(count(*((step * k, 0) for k in range(16))), expected, rtol=1e-9)


def test_a_view_given_twice_tells_the_volume_nothing_new():
    tree, where = fork(), grid(64)
    # Pictures of a tree that is half a millimetre thicker: there is something to correct.
    thicker = Tree(
        nodes_mm=tree.nodes_mm,
        branches=tuple(
            branch(b.points_mm, b.radius_mm + 0.5, b.start, b.end) for b in tree.branches
        ),
    )
    views = seen(thicker, two_views())
    model = [
        footprint(tubes_of(tree), v.carm, 1.0).image((v.carm.rows, v.carm.columns)) for v in views
    ]

    def volume(times):
        given = (views * times, (1.0,) * 2 * times, None, OPTIONS.edge_blur_mm)
        return tube_volume(tree, where, *given, model * times)

    round_only = tube_volume(tree, where, (), (), None, OPTIONS.edge_blur_mm)
    once, thrice = volume(1), volume(3)
    assert np.abs(once - round_only).max() > 0.1
    np.testing.assert_allclose(thrice, once, atol=0.01)


@pytest.mark.slow
def test_more_views_are_never_worse():
    """A generated tree (seed of its own) in the paper's set-up, from pictures to voxels."""
    from gcar_deploy.engine import Engine
    from gcar_deploy.geometry.scene import Intensity
    from gcar_deploy.imaging.angiogram import Angiogram
    from gcar_deploy.measure.metrics import volume_measures
    from gcar_export.scenes.protocols import case_geometry
    from gcar_export.scenes.render import occupancy, path_lengths
    from gcar_export.scenes.trees import random_tree

    segments = random_tree(np.random.default_rng([905, 1])).segments()
    engine, found = Engine(), {}
    for count in (2, 8, 16):
        carms, where = case_geometry("paper", count)
        pictures = [
            Angiogram(
                view_id=str(k + 1),
                carm=view,
                pixels=path_lengths(view, *segments),
                bit_depth=16,
                intensity=Intensity(kind="path_length", polarity="bright", mm_per_count=1.0),
                sha256=str(k),
            )
            for k, view in enumerate(carms)
        ]
        volume = engine.reconstruct(pictures, where).volume
        if not found:
            near = np.zeros(where.shape, bool)
            near[tuple(np.rint(where.world2index(segments[0])).astype(int).T)] = True
            near = ndimage.binary_dilation(near, np.ones((3, 3, 3)), iterations=4)
            truth = np.zeros(where.shape, np.float32)
            points = where.index2world(np.argwhere(near))
            truth[near], _, _ = occupancy(points, float(where.spacing_mm[0]), *segments)
        measures = volume_measures(truth, volume, where.spacing_mm)
        found[count] = measures["dsc"].value, measures["ot_2mm"].value
    assert found[8][0] > found[2][0] + 0.02
    for few, many in ((2, 8), (8, 16)):
        assert found[many][0] >= found[few][0] - 0.005, found
        assert found[many][1] >= found[few][1] - 0.005, found
