import dataclasses

import numpy as np
import pytest

from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.model import box_chord, footprint, tubes_of
from tests.tree.shapes import branch, fork, tube
from tests.tubes.scenes import carm, two_views


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


@pytest.mark.parametrize("slant_deg", [0.0, 30.0, 55.0])
def test_a_width_says_nothing_of_how_slanted_a_tube_is(slant_deg):
    view = carm(0, 0)
    ray = -view.source_mm / np.linalg.norm(view.source_mm)
    axis = (
        np.cos(np.radians(slant_deg)) * np.array([0, 0, 1.0]) + np.sin(np.radians(slant_deg)) * ray
    )
    line = np.linspace(-15, 15, 31)[:, None] * axis
    tubes = tubes_of(Tree(nodes_mm=line[[0, -1]], branches=(branch(line, 1.5),)))
    middle = np.s_[126:130]
    width = footprint(tubes, view, 0.1, shown="width").image((256, 256))[middle].max()
    path = footprint(tubes, view, 0.1).image((256, 256))[middle].max()
    assert width == pytest.approx(3.0, rel=0.02)
    assert path == pytest.approx(3.0 / np.cos(np.radians(slant_deg)), rel=0.02)


@pytest.mark.parametrize("radii", [(1.5, 0.8), (1.2, 1.2), (0.7, 1.5, 1.0), (0.5, 0.9, 1.3, 1.7)])
def test_of_tubes_behind_one_another_the_widest_shows(radii):
    view, nodes, branches = carm(0, 0), [], []
    for k, radius in enumerate(radii):
        turn = 0.3 * k
        along = np.linspace(-15, 15, 31)[:, None] * [np.cos(turn), 0.0, np.sin(turn)]
        line = along + np.array([0.0, 12.0 * k, 0.0])
        nodes += [line[0], line[-1]]
        branches.append(branch(line, radius, 2 * k, 2 * k + 1))
    alone = [
        footprint(
            tubes_of(
                Tree(nodes_mm=one.points_mm[[0, -1]], branches=(branch(one.points_mm, radius),))
            ),
            view, 1.0, shown="width",
        ).image((256, 256))
        for one, radius in zip(branches, radii, strict=True)
    ]  # fmt: skip
    tree = Tree(nodes_mm=np.array(nodes), branches=tuple(branches))
    both = footprint(tubes_of(tree), view, 1.0, shown="width")
    np.testing.assert_allclose(both.image((256, 256)), np.max(alone, axis=0), atol=1e-9)
    # What is hidden pulls at nothing, and a pixel that shows one tube is one equation for it.
    assert both.crossings.max() == 1
    hidden = both.path_mm == 0
    assert not both.d_axis[:, hidden].any() and not both.d_log_radius[hidden].any()


@pytest.mark.parametrize("seed", range(10))
def test_rounding_does_not_choose_between_tubes_as_wide_as_each_other(seed):
    """Branches that end in one node are caps of one size beyond it, of numbers added up."""
    view, rng = carm(31, 17), np.random.default_rng(seed)
    nodes = np.array([[1.237, 0.411, -0.893], [-9.1, 1.3, 14.7], [-4.3, 2.6, 17.9]])
    wide, thin = rng.uniform(0.6, 0.97), rng.uniform(0.3, 0.7, 2)

    def seen(off):
        place = nodes + off * rng.normal(size=nodes.shape)
        branches = [
            branch(place[[k, 0]], [thin[k - 1], wide * (1 + 7 * off)], k, 0) for k in (1, 2)
        ]
        tree = Tree(nodes_mm=place, branches=tuple(branches))
        return footprint(tubes_of(tree), view, 1.0, shown="width").path_mm

    np.testing.assert_allclose(seen(1e-12), seen(0.0), atol=1e-6)


def test_pairs_kept_from_before_give_the_same_picture():
    tubes, view = tubes_of(fork()), carm(30, 20)
    first = footprint(tubes, view, 1.0)
    moved = dataclasses.replace(
        tubes, positions_mm=tubes.positions_mm + 0.1, log_radius=tubes.log_radius + 0.05
    )
    fresh = footprint(moved, view, 1.0)
    kept = footprint(moved, view, 1.0, first.pairing)
    assert kept.pairing is first.pairing
    # But for pixels between two segments, where either says nearly the same.
    np.testing.assert_allclose(kept.image((256, 256)), fresh.image((256, 256)), atol=0.06)
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


def test_picture_of_one_branch_against_every_pixel_and_every_segment():
    t = np.linspace(0, 3 * np.pi, 61)
    line = np.stack([12 * np.cos(t), 12 * np.sin(t), np.linspace(-12, 12, 61)], 1)
    tree = Tree(nodes_mm=line[[0, -1]], branches=(branch(line, 1.1),))
    view = carm(25, -15)
    seen = footprint(tubes_of(tree), view, 1.0)
    pixels, depth = view.project(line)
    a, step = pixels[:-1], np.diff(pixels, axis=0)
    grid = np.stack(np.meshgrid(np.arange(256), np.arange(256)), -1).reshape(-1, 1, 2)
    s = np.clip(np.sum((grid - a) * step, -1) / np.sum(step * step, -1), 0, 1)
    distance = np.linalg.norm(grid - a - s[..., None] * step, axis=-1).min(axis=1)
    reach = 1.1 * np.sqrt(np.prod(view.focal_px)) / depth + 0.5
    # Every pixel within reach of some segment is covered, no other is.
    covered = np.zeros(256 * 256, bool)
    covered[seen.pixel[seen.path_mm > 0]] = True
    assert covered[distance < reach.min() - 1e-6].all()
    assert not covered[distance > reach.max() + 1e-6].any()
    # Entries come in order of their segments; where a pixel has one, it is the nearest segment's.
    assert (np.diff(seen.segment) >= 0).all()
    single = (seen.crossings == 1) & (seen.path_mm > 0)
    axis = a[seen.segment] + seen.t[:, None] * step[seen.segment]
    own = np.linalg.norm(grid[seen.pixel, 0] - axis, axis=1)
    np.testing.assert_allclose(own[single], distance[seen.pixel[single]], atol=1e-3)
    np.testing.assert_allclose(seen.image((256, 256)).reshape(-1)[seen.covered], seen.totals())


def test_path_is_continuous_where_segments_meet():
    # A bend towards the beam: the two segments' own angles to the ray differ.
    line = np.array([[-10.0, 0, 0], [-5, 0, 0], [0, 0, 0], [4, 3, 0], [8, 6, 0], [12, 9, 0]])
    tree = Tree(nodes_mm=line[[0, -1]], branches=(branch(line, 1.5),))
    view = carm(0, 0)
    before, after = (
        footprint(tubes_of(tree), view.moved([dx, 0, 0]), 1.0).image((256, 256))
        for dx in (-1e-6, 1e-6)
    )
    assert np.abs(before - after).max() < 1e-3


def test_where_a_picture_begins_does_not_say_which_segment_a_pixel_is_nearest_to():
    # Pixels on the outside of a bend are as far from either segment: rounding must not choose.
    tubes, view = tubes_of(fork()), carm(30, 20)
    column, row = view.principal_point
    wider = dataclasses.replace(
        view, rows=view.rows + 7, columns=view.columns + 5, principal_point_px=(column + 5, row + 7)
    )
    a, b = (footprint(tubes, v, 1.0) for v in (view, wider))
    np.testing.assert_array_equal(a.segment, b.segment)
    np.testing.assert_array_equal(
        (a.pixel // view.columns + 7) * wider.columns + a.pixel % view.columns + 5, b.pixel
    )
