"""Neighbour tables, coarse levels and rays against slow, obvious twins."""

import dataclasses
from unittest import mock

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcar_deploy.config import CandidateOptions
from gcar_deploy.predict import encoding
from gcar_deploy.predict.encoding import (
    LEVELS,
    VIEW_FEATURES,
    _depth_in_vessel,
    _levels,
    _neighbours,
    encode,
)
from gcar_deploy.predict.hull import cubic_lattice, visual_hull
from gcar_deploy.predict.lattices import shifted_lattice
from gcar_deploy.predict.thinning import thin_hull

pytest.importorskip("gcar_export.scenes.render", reason="needs the export extra")
from tests.predict.test_hull import GRID, helix, scene


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 60), st.integers(0, 10**6), st.booleans())
def test_neighbours_equal_a_dictionary(n, seed, searched):
    rng = np.random.default_rng(seed)
    index = np.unique(rng.integers(0, 6, (n, 3)), axis=0)
    at = {tuple(i): k for k, i in enumerate(index)}
    with mock.patch.object(encoding, "MAX_TABLE", 0 if searched else encoding.MAX_TABLE):
        table = _neighbours(index)
    for k, i in enumerate(index):
        wanted = [
            at.get((i[0] + x, i[1] + y, i[2] + z), len(index))
            for x in (-1, 0, 1)
            for y in (-1, 0, 1)
            for z in (-1, 0, 1)
        ]
        assert table[k].tolist() == wanted


def test_mirrored_neighbours_are_mutual():
    table = _neighbours(visual_hull(scene(), GRID, CandidateOptions()).index)
    n = len(table)
    for k in range(27):
        here = np.flatnonzero(table[:, k] < n)
        np.testing.assert_array_equal(table[table[here, k], 26 - k], here)


def test_levels_lead_to_the_cell_that_holds_the_point():
    index = visual_hull(scene(), GRID, CandidateOptions()).index
    neighbours, parent = _levels(index)
    assert len(neighbours) == LEVELS + 1 and len(parent) == LEVELS
    fine = index
    for level in range(LEVELS):
        coarse = np.unique(fine // 2, axis=0)
        np.testing.assert_array_equal(coarse[parent[level]], fine // 2)
        assert len(neighbours[level + 1]) == len(coarse)
        fine = coarse


@pytest.mark.parametrize("number", [0, 1, 2, 3])
def test_what_a_border_adds_to_the_default_volume_changes_no_coarser_cell(number):
    views = [(*one, True) for one in scene()]
    paths = [one[:2] for one in views]
    found = []
    for cells in range(96, 113):
        space = dataclasses.replace(GRID, size_mm=(cells + 0.3,) * 3, bounds=False)
        lattice = shifted_lattice(cubic_lattice(space, 1.0), number)
        found.append(encode(visual_hull(paths, lattice, CandidateOptions()), views))
    assert len({len(one.parent[0]) for one in found}) == 1
    for one in found[1:]:
        for name in ("parent", "neighbours", "children"):
            for a, b in zip(getattr(one, name), getattr(found[0], name), strict=True):
                np.testing.assert_array_equal(a, b)


def test_the_depth_in_a_vessel_has_no_digit_of_the_size_of_the_picture():
    blob = np.zeros((60, 60), np.float32)
    blob[tuple(np.random.default_rng(0).integers(8, 52, (2, 400)))] = 1
    blob = cv2.dilate(blob, np.ones((7, 7), np.uint8))
    expected = _depth_in_vessel(blob)
    assert expected.max() > 3
    for more in (1, 2, 3, 5, 9, 17, 66, 250):
        wide = np.pad(blob, ((more, 2 * more), (more, 3)))
        found = _depth_in_vessel(wide)[more : more + 60, more : more + 60]
        np.testing.assert_array_equal(found, expected)


def test_members_and_children_are_rays_and_parents_inverted():
    views = scene()
    hull = visual_hull(views, GRID, CandidateOptions())
    e = encode(hull, [(c, p, True) for c, p in views])
    for k in range(2):
        for r in range(0, e.ray_path.shape[1], 37):
            inside = e.members[k, r][e.members[k, r] < len(hull)]
            assert inside.tolist() == np.flatnonzero(e.ray[k] == r).tolist()
    for parent, children in zip(e.parent, e.children, strict=True):
        owner, column = np.nonzero(children < len(parent))
        np.testing.assert_array_equal(parent[children[owner, column]], owner)
        assert len(owner) == len(parent)


def test_encoded_rays_carry_the_path_of_their_pixel():
    views = scene()
    hull = visual_hull(views, GRID, CandidateOptions())
    e = encode(hull, [(c, p, True) for c, p in views])
    assert e.features.shape == (2, len(hull), VIEW_FEATURES)
    assert np.isfinite(e.features).all()
    for k, (c, path) in enumerate(views):
        px = np.rint(c.project(hull.points_mm)[0]).astype(int)
        np.testing.assert_allclose(e.ray_path[k][e.ray[k]], path[px[:, 1], px[:, 0]], rtol=1e-6)


def test_weight_conserves_mass():
    """Full cells along the whole helix explain the path lengths of its pixels."""
    views = scene()
    hull = visual_hull(views, GRID, CandidateOptions(min_path_cells=0.05))
    e = encode(hull, [(c, p, True) for c, p in views])
    from gcar_export.scenes.render import occupancy

    p = helix()
    share, _, _ = occupancy(hull.points_mm, 1.0, p[:-1], p[1:], np.full(len(p) - 1, 1.6))
    for k in range(2):
        made = float((share * e.weight[k]).sum())
        assert made == pytest.approx(float(e.ray_path[k].sum()), rel=0.04)


def test_thinning_explains_every_pixel_once():
    views = scene()
    hull = visual_hull(views, GRID, CandidateOptions())
    e = encode(hull, [(c, p, True) for c, p in views])
    centers = thin_hull(hull, e)
    assert ((centers.confidence >= 0) & (centers.confidence <= 1)).all()
    for ray, path, weight in zip(e.ray, e.ray_path, e.weight, strict=True):
        made = np.bincount(ray, centers.confidence * weight, minlength=len(path))
        assert np.abs(made - path).sum() < 0.25 * path.sum()
    # A helix alone has few ghosts: half of what is chosen lies on it.
    chosen = centers.points_mm[centers.confidence > 0.5]
    gap = np.linalg.norm(chosen[:, None] - helix()[None], axis=2).min(axis=1)
    assert (gap < 2.5).mean() > 0.5
