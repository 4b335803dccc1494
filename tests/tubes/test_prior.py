"""The taper's prior: tight on coarse pixels, loose enough for a narrow core on fine ones."""

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import TubeOptions
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes import prior
from gcar_deploy.tubes.fit import fit_tubes
from gcar_deploy.tubes.model import tubes_of
from gcar_deploy.tubes.prior import make_prior, taper_easing
from tests.tree.shapes import branch, fork, grid, points_of
from tests.tubes.scenes import seen, two_views

OPTIONS = TubeOptions()


@pytest.mark.parametrize(
    ("pixel_mm", "factor"),
    [(np.inf, 1.0), (1.08, 1.0), (0.85, 1.0), (0.425, 2.0), (0.27, 3.0), (0.05, 3.0)],
)
def test_easing_grows_as_pixels_shrink_and_is_bounded(pixel_mm, factor):
    assert taper_easing(pixel_mm) == pytest.approx(factor)


def test_only_the_taper_is_eased():
    tubes = tubes_of(fork())
    coarse = make_prior(tubes, np.ones(len(tubes.log_radius)), OPTIONS)
    fine = coarse.at_pixel(0.425, OPTIONS)
    assert coarse.at_pixel(1.0, OPTIONS) is coarse
    start = np.concatenate([tubes.positions_mm.reshape(-1), tubes.log_radius])
    bent, tapered = start.copy(), start.copy()
    bent[: 3 * len(tubes.positions_mm)] += np.random.default_rng(0).normal(
        0, 0.1, 3 * len(tubes.positions_mm)
    )
    assert fine.value(bent) == pytest.approx(coarse.value(bent))
    # A step of the log radius in the middle of a branch, less what the anchors take of it.
    tapered[3 * len(tubes.positions_mm) + 10] += 0.2
    free = dataclasses.replace(OPTIONS, taper=1e9)
    anchors = make_prior(tubes, coarse.trust, free).value(tapered)
    level = make_prior(tubes, coarse.trust, free).value(start)
    step = [p.value(tapered) - p.value(start) - (anchors - level) for p in (coarse, fine)]
    assert step[0] == pytest.approx(4 * step[1], rel=1e-6)


def narrowed():
    """A tube of 1.5 mm radius with a core of 0.6 mm, half as deep 2 mm away."""
    z = np.linspace(-25, 25, 101)
    radius = 1.5 - 0.9 * np.exp(-0.5 * (z / 1.7) ** 2)
    line = np.stack([0.1 * z, 0.2 * z, z], axis=1)
    return Tree(nodes_mm=line[[0, -1]], branches=(branch(line, radius),))


def test_a_narrow_core_is_seen_in_fine_pixels(monkeypatch):
    truth = narrowed()
    views = seen(truth, two_views(512, 0.3))
    centers = points_of(truth, grid(64))
    least = {}
    options = dataclasses.replace(OPTIONS, radius_refit_steps=0)
    eased = prior.MOST_TAPER_EASING
    for most in (1.0, eased):
        monkeypatch.setattr(prior, "MOST_TAPER_EASING", most)
        tree = fit_tubes(centers, views, options).tree
        middle = np.abs(tree.points()[:, 2]) < 5
        least[most] = tree.radii()[middle].min() - 0.6
    assert abs(least[eased]) < 0.5 * least[1.0]
