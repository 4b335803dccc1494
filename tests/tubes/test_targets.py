"""The contrast of a picture that is not calibrated: weighted least squares on what tubes cover."""

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import TubeOptions
from gcar_deploy.tubes.targets import CONTRAST_SIGMAS, Target, make_targets
from tests.tree.shapes import fork
from tests.tubes.scenes import carm, seen, seen_as_masks, two_views

CARM, COVERED = carm(30, 20, size=16), np.array([5, 9])


def _target(**how) -> Target:
    """Two pixels at 2 and 3 times a model of 1 mm, the second noisy and half as heavy."""
    shape = (CARM.rows, CARM.columns)
    path, weight, sigma = np.full(shape, 7.0), np.ones(shape), np.ones(shape)
    path.flat[COVERED], weight.flat[9], sigma.flat[9] = (2.0, 3.0), 0.5, 2.0
    given = {"path_error": 0.3, "box_px": 1.0, "pixel_mm": 0.5} | how
    return Target(carm=CARM, path_mm=path, weight=weight, sigma_mm=sigma, **given)


def test_contrast_is_the_weighted_mean_on_the_pixels_that_are_covered():
    fitted = _target().with_contrast(COVERED, np.ones(2))
    # Weights over variance: 1 and 0.5 / 4; the pixels at 7 mm are covered by nothing.
    assert fitted.contrast == pytest.approx((2 + 3 / 8) / (1 + 1 / 8))


def test_contrast_is_held_to_what_its_error_allows_and_is_one_where_it_is_known():
    most = 1 + CONTRAST_SIGMAS * 0.3
    thin = np.full(2, 1e-3)
    assert _target().with_contrast(COVERED, thin).contrast == pytest.approx(most)
    assert _target().with_contrast(COVERED, 100 * np.ones(2)).contrast == pytest.approx(1 / most)
    kept = dataclasses.replace(_target(path_error=0.0), contrast=1.0)
    assert kept.with_contrast(COVERED, thin) is kept
    assert _target().with_contrast(COVERED[:0], thin[:0]).contrast == 1.0


def test_only_the_own_pixels_of_masks_show_widths():
    views = [seen(fork(), two_views())[0], seen_as_masks(fork(), two_views())[1]]
    shown = [
        [target.shown for target in make_targets(views, level, TubeOptions())]
        for level in (1.0, 0.0)
    ]
    assert shown == [["path", "path"], ["path", "width"]]
