"""The twins behind the refiner give what NumPy gives, within the stated tolerance."""

import dataclasses

import numpy as np
import pytest

from gcar_deploy.errors import UsageError
from gcar_deploy.gaussians.backends import (
    GRADIENT_TOLERANCE,
    PICTURE_TOLERANCE,
    backend_named,
)
from gcar_deploy.gaussians.paper import refine_paper
from tests.gaussians.test_paper import OPTIONS, points, views_of
from tests.gaussians.test_project import carm, random_gaussians


@pytest.mark.parametrize(
    ("name", "device", "words"),
    [
        ("jax", "cpu", "one of numpy, numba, torch"),
        ("torch", "tpu", "one of cpu, cuda"),
        ("numpy", "cuda", "needs the backend torch"),
        ("numba", "cuda", "needs the backend torch"),
    ],
)
def test_what_is_not_there_is_said(name, device, words):
    with pytest.raises(UsageError, match=words):
        backend_named(name, device)


@pytest.mark.slow
def test_compiled_loops_are_the_same_sums():
    """The same windows, so rounding alone: also behind the source, off the picture, unturned."""
    pytest.importorskip("numba")
    numpy, numba = backend_named("numpy"), backend_named("numba")
    g = random_gaussians(60, 3, spread=60)
    quaternions, means = g.quaternions_wxyz.copy(), g.means_mm.copy()
    quaternions[5] = 0
    view = carm(48, 3.7, 30.0, 20.0)
    means[9] = 2 * view.source_mm
    means[11] += 1e4
    g = dataclasses.replace(g, means_mm=means, quaternions_wxyz=quaternions)
    picture = numpy.project(g, view)
    assert picture.max() > 0
    np.testing.assert_allclose(numba.project(g, view), picture, atol=1e-12 * picture.max())
    by_picture = np.random.default_rng(0).normal(size=picture.shape)
    expected, found = numpy.vjp(g, view, by_picture), numba.vjp(g, view, by_picture)
    for field in dataclasses.fields(expected):
        a, b = getattr(found, field.name), getattr(expected, field.name)
        assert np.abs(a - b).max() <= 1e-11 * np.abs(b).max(), field.name


def devices():
    torch = pytest.importorskip("torch")
    return ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)


@pytest.mark.slow
def test_pictures_and_gradients_agree():
    numpy = backend_named("numpy")
    g = random_gaussians(20, 3, spread=30)
    quaternions = g.quaternions_wxyz.copy()
    quaternions[5] = 0
    means = g.means_mm.copy()
    view = carm(32, 5.6, 30.0, 20.0)
    means[9] = 2 * view.source_mm
    g = dataclasses.replace(g, means_mm=means, quaternions_wxyz=quaternions)
    picture = numpy.project(g, view)
    rng = np.random.default_rng(0)
    by_picture = rng.normal(size=picture.shape)
    expected = numpy.vjp(g, view, by_picture)
    for device in devices():
        torch = backend_named("torch", device)
        made = torch.project(g, view)
        assert np.abs(made - picture).max() <= PICTURE_TOLERANCE * picture.max()
        found = torch.vjp(g, view, by_picture)
        for field in dataclasses.fields(expected):
            a, b = getattr(found, field.name), getattr(expected, field.name)
            if field.name == "quaternions_wxyz":
                a, b = np.delete(a, 5, 0), np.delete(b, 5, 0)
            assert np.linalg.norm(a - b) <= GRADIENT_TOLERANCE * np.linalg.norm(b), field.name


@pytest.mark.slow
def test_a_refinement_ends_in_the_same_place():
    truth = random_gaussians(12, 2, spread=20, sigma=(1.5, 2.5))
    start, views = points(truth, 1.0), views_of(truth, 32)
    options = dataclasses.replace(OPTIONS, steps=5, control_every=0)
    numpy = refine_paper(start, views, options)
    for device in devices():
        torch = refine_paper(
            start, views, dataclasses.replace(options, backend="torch", device=device)
        )
        assert torch.status == "ok" and torch.steps == numpy.steps
        np.testing.assert_allclose(torch.losses, numpy.losses, rtol=0.02)
        assert np.abs(torch.gaussians.means_mm - numpy.gaussians.means_mm).max() < 0.1
