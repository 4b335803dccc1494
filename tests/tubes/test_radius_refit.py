"""Radii refitted with the axes held: narrow cores, no lesion where there is none."""

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import TubeOptions
from gcar_deploy.measure.lumen import tree_lumens
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.fit import fit_tubes
from gcar_deploy.tubes.gauss_newton import footprints
from gcar_deploy.tubes.model import tubes_of
from gcar_deploy.tubes.radius_refit import refit_radii
from gcar_deploy.tubes.targets import make_targets
from tests.tree.shapes import branch, grid, points_of
from tests.tubes.scenes import seen, two_views

OPTIONS = TubeOptions()
LINE = np.linspace([-20.0, -6.0, 15.0], [22.0, 9.0, -14.0], 70)


def tube(radius):
    return Tree(nodes_mm=LINE[[0, -1]], branches=(branch(LINE, radius, 0, 1),))


def narrowed(share, length_mm=9.0, healthy=1.5):
    arc = np.linalg.norm(LINE - LINE[0], axis=1)
    off = np.clip(2 * np.abs(arc - arc[35]) / length_mm, 0, 1)
    return healthy * (1 - share * 0.5 * (1 + np.cos(np.pi * off)))


def views_of(tree, noise_mm=0.0, **how):
    views = seen(tree, two_views(512, 0.39), **how)
    rng = np.random.default_rng(3)
    return [
        dataclasses.replace(
            view,
            path_mm=view.path_mm + (noise_mm * rng.normal(size=view.path_mm.shape)).astype("f4"),
        )
        for view in views
    ]


def refitted(start, views, options=OPTIONS):
    """Radii of ``start``'s tubes after the refit."""
    tubes, targets = tubes_of(start), make_targets(views, 0.0, options)
    return refit_radii(tubes, targets, footprints(tubes, targets), options)[0].radius_mm


def test_a_core_that_was_rounded_off_comes_back():
    truth, rounded = narrowed(0.6), narrowed(0.4, 14.0)
    found = refitted(tube(rounded), views_of(tube(truth), noise_mm=0.05))
    assert abs(found.min() - truth.min()) < 0.08 < rounded.min() - truth.min()
    assert np.abs(found - truth)[5:-5].max() < 0.2


def test_prints_are_those_of_the_new_radii():
    tubes = tubes_of(tube(narrowed(0.2)))
    targets = make_targets(views_of(tube(narrowed(0.6))), 0.0, OPTIONS)
    after, prints = refit_radii(tubes, targets, footprints(tubes, targets), OPTIONS)
    for print_, fresh in zip(prints, footprints(after, targets), strict=True):
        shape = targets[0].path_mm.shape
        np.testing.assert_allclose(print_.image(shape), fresh.image(shape), atol=1e-9)


def test_noise_makes_no_lesion():
    healthy = np.linspace(1.6, 1.2, len(LINE))
    found = refitted(tube(healthy), views_of(tube(healthy), noise_mm=0.3))
    assert np.abs(found / healthy - 1).max() < 0.1
    assert tree_lumens(tube(found))[0].stenosis_percent < 10


def test_nothing_is_guessed_where_the_contrast_is_unknown():
    start = tube(narrowed(0.2))
    found = refitted(start, views_of(tube(narrowed(0.6)), calibrated=False))
    np.testing.assert_array_equal(found, tubes_of(start).radius_mm)


@pytest.mark.parametrize(("size", "spacing", "refits"), [(512, 0.39, True), (128, 1.56, False)])
def test_only_fine_pixels_are_asked(size, spacing, refits):
    truth = tube(narrowed(0.6))
    views = seen(truth, two_views(size, spacing))
    start = points_of(truth, grid())
    options = [dataclasses.replace(OPTIONS, radius_refit_steps=steps) for steps in (0, 3)]
    found = [fit_tubes(start, views, each) for each in options]
    least = [fit.tree.radii()[3:-3].min() for fit in found]
    assert (least[1] < least[0] - 0.02) == refits
    if refits:
        assert abs(least[1] - 0.6) < abs(least[0] - 0.6)
        # The model's pictures are handed on to the volume: they must show the new radii.
        images = [p.image((size, size)) for p in footprints(
            tubes_of(found[1].tree), make_targets(views, 0.0, OPTIONS))]  # fmt: skip
        for image, model in zip(images, found[1].model_mm, strict=True):
            # But for pixels between two segments (``pairing``).
            np.testing.assert_allclose(image, model, atol=0.02)
