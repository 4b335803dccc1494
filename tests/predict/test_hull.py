"""The hull holds every vessel point, costs no cube, and does not care how views are ordered."""

import numpy as np
import pytest

from gcar_deploy.config import CandidateOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.predict.hull import bilinear, cubic_lattice, visual_hull

render = pytest.importorskip("gcar_export.scenes.render", reason="needs the export extra")

GRID = Grid(center_mm=(0, 0, 0), size_mm=(96, 96, 96), shape=(96, 96, 96))


def carm(a, b):
    return CArm(
        primary_angle_deg=a,
        secondary_angle_deg=b,
        sod_mm=765,
        sdd_mm=1100,
        rows=128,
        columns=128,
        pixel_spacing_mm=(1.4, 1.4),
    )


def helix(n=120):
    t = np.linspace(0, 4 * np.pi, n)
    return np.stack([25 * np.cos(t), 25 * np.sin(t), 3 * t - 18], axis=1)


def scene(angles=((-30, -20), (45, 25))):
    p = helix()
    r = np.full(len(p) - 1, 1.6)
    return [(c := carm(a, b), render.path_lengths(c, p[:-1], p[1:], r)) for a, b in angles]


def test_every_centreline_point_is_kept_and_little_else():
    hull = visual_hull(scene(), GRID, CandidateOptions())
    index = {tuple(i) for i in hull.index}
    for p in np.rint(GRID.world2index(helix())).astype(int):
        assert tuple(p) in index
    assert len(hull) < 0.03 * 96**3
    np.testing.assert_allclose(hull.points_mm, GRID.index2world(hull.index))


def test_coarse_to_fine_equals_brute_force():
    views = scene()
    hull = visual_hull(views, GRID, CandidateOptions(min_path_cells=0.5))
    every = np.argwhere(np.ones(GRID.shape, bool))
    keep = np.ones(len(every), bool)
    for c, path in views:
        keep &= bilinear(path, c.project(GRID.index2world(every))[0]) > 0.5
    np.testing.assert_array_equal(hull.index, every[keep])


@pytest.mark.req("REQ-34")
def test_order_of_views_is_nothing():
    a = visual_hull(scene(), GRID, CandidateOptions())
    b = visual_hull(scene()[::-1], GRID, CandidateOptions())
    np.testing.assert_array_equal(a.index, b.index)


def test_a_third_view_only_removes():
    two = scene()
    three = scene(((-30, -20), (45, 25), (0, 30)))
    a = {tuple(i) for i in visual_hull(two, GRID, CandidateOptions()).index}
    b = {tuple(i) for i in visual_hull(three, GRID, CandidateOptions()).index}
    assert b < a


def test_blank_view_gives_none():
    views = scene()
    views[1] = (views[1][0], np.zeros_like(views[1][1]))
    assert len(visual_hull(views, GRID, CandidateOptions())) == 0


def test_a_lattice_belongs_to_the_scene_not_to_the_volume_asked_for():
    lattice = cubic_lattice(GRID, 1.0)
    assert lattice.shape == GRID.shape
    # near the voxels of a grid about the isocentre, but off the edges between pixels
    off = lattice.index2world(np.zeros((1, 3))) - GRID.index2world(np.zeros((1, 3)))
    assert (np.abs(off) < 0.02).all() and (np.abs(off) > 0.005).all()
    larger = Grid(center_mm=(7.3, -2.1, 0), size_mm=(120, 110, 97), shape=(60, 50, 40))
    other = cubic_lattice(larger, 1.0)
    steps = (other.index2world(np.zeros((1, 3))) - lattice.index2world(np.zeros((1, 3)))) / 1.0
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
    a, b = (visual_hull(scene(), x, CandidateOptions()).points_mm for x in (lattice, other))
    inside = (np.abs(b) < 48).all(axis=1)
    assert len(a) > 100 and len(b) >= len(a)
    np.testing.assert_allclose(a, b[inside], atol=1e-9)


def test_a_lattice_covers_a_grid_of_other_voxels():
    flat = Grid(center_mm=(1, 2, 3), size_mm=(90, 90, 60), shape=(300, 300, 20))
    lattice = cubic_lattice(flat, 1.0)
    assert lattice.shape == (90, 90, 60)
    assert np.allclose(lattice.spacing_mm, 1.0)
