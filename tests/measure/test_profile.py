"""Profiles of known lumens behind known blur, by brute-force convolution."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from gcar_deploy.measure.profile import (
    DEPTH,
    HALF,
    Belief,
    Profiles,
    blurred_chord,
    fit_profiles,
)

FINE = np.arange(-8, 8, 0.002)
X = np.linspace(-3, 3, 41)


def convolved(half, blur, shift=0.0):
    chord = 2 * np.sqrt(np.maximum(half**2 - FINE**2, 0))
    return np.interp(X + shift, FINE, gaussian_filter1d(chord, blur / 0.002))


@pytest.mark.parametrize(("half", "blur"), [(1.0, 0.1), (0.3, 0.3), (2.0, 0.2), (0.2, 0.6)])
def test_the_table_is_the_convolution(half, blur):
    g, slope, growth = (v[0] for v in blurred_chord(X[None], np.array([half]), blur))
    top = convolved(half, blur).max()
    np.testing.assert_allclose(half * g, convolved(half, blur), atol=2e-3 * top)
    step = 0.02
    wider = (convolved(half * (1 + step), blur) - convolved(half * (1 - step), blur)) / (2 * step)
    np.testing.assert_allclose(half * growth, wider, atol=0.02 * np.abs(wider).max())
    along = (convolved(half, blur, 0.005) - convolved(half, blur, -0.005)) / 0.01
    np.testing.assert_allclose(slope, along, atol=0.02 * top / half)


@pytest.mark.parametrize("oval", [0.7, 1.0, 1.4])
@pytest.mark.parametrize(("half", "noise"), [(0.4, 0.02), (1.0, 0.05), (2.0, 0.1)])
def test_area_comes_back_and_its_scatter_is_as_said(half, noise, oval):
    blur, n = 0.2, 400
    x = np.tile(np.linspace(-1, 1, 33) * (1.6 * half + 1.2), (n, 1))
    rng = np.random.default_rng(0)
    clean = oval * half * blurred_chord(x - 0.1, np.full(n, half), blur)[0]
    seen = Profiles(x, clean + noise * rng.normal(size=x.shape), np.ones_like(x))
    start = np.tile([0.0, np.log(1.3 * half), 0.0, 0.0, 0.0], (n, 1))
    belief = Belief(start, np.array([0.5, 0.5, 0.25, 0.03, 0.03]))
    fit = fit_profiles(seen, np.ones(n), blur, belief, noise)
    log_radius = fit.values[:, HALF] + 0.5 * fit.values[:, DEPTH]
    C = fit.covariance
    told = np.sqrt(C[:, HALF, HALF] + C[:, HALF, DEPTH] + 0.25 * C[:, DEPTH, DEPTH])
    assert log_radius.mean() == pytest.approx(np.log(half * np.sqrt(oval)), abs=0.02)
    assert 0.6 < log_radius.std() / told.mean() < 1.3
