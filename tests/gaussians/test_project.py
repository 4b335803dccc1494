"""Projection against quadrature, exact rays, an independent projector, and its own gradient."""

import numpy as np
import pytest
from scipy.integrate import quad

from gcar_deploy.errors import UsageError
from gcar_deploy.gaussians.footprint import exact_line_integral
from gcar_deploy.gaussians.gaussians import Gaussians, concatenate, rotation_matrices
from gcar_deploy.gaussians.project import project, project_vjp
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid


def carm(size=128, pitch=1.4, a=30.0, b=25.0):
    return CArm(
        primary_angle_deg=a,
        secondary_angle_deg=b,
        sod_mm=750,
        sdd_mm=1100,
        rows=size,
        columns=size,
        pixel_spacing_mm=(pitch, pitch),
    )


def random_gaussians(n, seed=0, spread=30.0, sigma=(0.8, 3.0)):
    rng = np.random.default_rng(seed)
    return Gaussians(
        means_mm=rng.uniform(-spread, spread, (n, 3)),
        scales_mm=np.exp(rng.uniform(*np.log(sigma), (n, 3))),
        quaternions_wxyz=rng.normal(size=(n, 4)),
        intensity=rng.uniform(0.3, 1.0, n),
    )


def vector(g):
    return np.concatenate(
        [g.means_mm, np.log(g.scales_mm), g.quaternions_wxyz, g.intensity[:, None]], axis=1
    )


def gaussians(v):
    return Gaussians(
        means_mm=v[:, :3],
        scales_mm=np.exp(v[:, 3:6]),
        quaternions_wxyz=v[:, 6:10],
        intensity=v[:, 10],
    )


def test_exact_line_integral_against_quadrature():
    rng = np.random.default_rng(1)
    g = random_gaussians(60, 1, sigma=(0.05, 5.0))
    inverse = np.linalg.inv(g.covariances())
    source = np.array([100.0, -600, 300])
    for i in range(len(g)):
        target = g.means_mm[i] + rng.normal(size=3) * g.scales_mm[i].mean()
        d = (target - source) / np.linalg.norm(target - source)
        got = exact_line_integral(g.select(np.array([i])), source, d[None])[0, 0]
        t0 = (g.means_mm[i] - source) @ d

        def density(t, i=i, d=d, t0=t0):
            x = source + (t0 + t) * d - g.means_mm[i]
            return g.intensity[i] * np.exp(-0.5 * x @ inverse[i] @ x)

        reach = 12 * g.scales_mm[i].max()
        want = quad(density, -reach, reach, epsabs=1e-13, epsrel=1e-12, limit=400, points=[0])[0]
        peak = g.intensity[i] * g.scales_mm[i].max() * np.sqrt(2 * np.pi)
        assert got == pytest.approx(want, abs=1e-9 * peak)


def test_line_integral_keeps_its_digits_in_single_precision():
    """The textbook exponent c - b^2/a is off by a third of the peak here."""
    g = random_gaussians(40, 2, sigma=(0.3, 0.5))
    source = carm().source_mm
    rays = g.means_mm + 0.2 - source
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    want = exact_line_integral(g, source, rays).diagonal()
    v = (g.means_mm - source).astype(np.float32)
    d32 = rays.astype(np.float32)
    t = np.sum(v * d32, axis=1, keepdims=True)
    w = v - t * d32
    white = [
        np.einsum("nij,ni->nj", g.rotations().astype(np.float32), x)
        / g.scales_mm.astype(np.float32)
        for x in (w, d32)
    ]
    a = np.sum(white[1] ** 2, axis=1)
    q = np.sum(np.cross(white[1], white[0]) ** 2, axis=1) / a
    got = g.intensity.astype(np.float32) * np.sqrt(np.float32(2 * np.pi) / a) * np.exp(-q / 2)
    assert np.abs(got - want).max() < 2e-4 * want.max()


@pytest.mark.parametrize(("sigma", "bound"), [((2.0, 2.2), 4e-3), ((1.5, 4.0), 2e-2)])
@pytest.mark.req("REQ-44")
def test_footprint_against_exact_rays_averaged_over_the_pixel(sigma, bound):
    view, g = carm(), random_gaussians(5, 3, sigma=sigma)
    image = project(g, view, cut_sigmas=6)
    sub = (np.arange(3) - 1) / 3
    total = np.zeros(view.rows * view.columns)
    cols, rows = np.meshgrid(np.arange(view.columns), np.arange(view.rows))
    for dc in sub:
        for dr in sub:
            rays = view.rays(np.column_stack([cols.ravel() + dc, rows.ravel() + dr]))
            total += exact_line_integral(g, view.source_mm, rays).sum(axis=1) / 9
    assert np.abs(image.ravel() - total).max() < bound * total.max()


@pytest.mark.parametrize("sigma", [0.1, 0.3, 0.5, 1.0])
@pytest.mark.parametrize(("size", "pitch"), [(128, 1.4), (512, 0.35)])
@pytest.mark.req("REQ-44")
def test_mass_is_conserved_however_thin(sigma, size, pitch):
    view, g = carm(size, pitch), random_gaussians(20, 4, sigma=(sigma, sigma * 1.01))
    depth = view.project(g.means_mm)[1]
    f = np.prod(view.focal_px)
    for i in range(len(g)):
        one = g.select(np.array([i]))
        image = project(one, view, cut_sigmas=6)
        # A pixel covers depth^2 / f mm^2; obliquity is the cube of the ray's cosine.
        ray = view.rays(view.project(one.means_mm)[0])[0]
        cosine = ray @ view.axes[2]
        mass = image.sum() * depth[i] ** 2 / f * cosine
        # Sampling at pixel centres aliases: Poisson's sum bounds it at the worst phase.
        s2 = (sigma * np.sqrt(f) / depth[i]) ** 2 + 1 / 12
        bound = 2e-3 + (1 + 2 * np.exp(-2 * np.pi**2 * s2)) ** 2 - 1
        assert mass == pytest.approx(one.masses_mm3()[0], rel=bound)


@pytest.mark.req("REQ-43")
def test_gradient_against_central_differences():
    view, g = carm(64, 2.8), random_gaussians(8, 5)
    weight = np.random.default_rng(5).normal(size=(64, 64))
    grad = project_vjp(g, view, weight, cut_sigmas=7)
    got = np.concatenate(
        [grad.means_mm, grad.log_scales, grad.quaternions_wxyz, grad.intensity[:, None]], axis=1
    )
    v, want = vector(g), np.zeros_like(got)
    for i in np.ndindex(v.shape):
        a, b = v.copy(), v.copy()
        a[i] += 1e-5
        b[i] -= 1e-5
        up, down = (project(gaussians(x), view, cut_sigmas=7) for x in (a, b))
        want[i] = np.sum((up - down) * weight) / 2e-5
    assert np.abs(got - want).max() < 1e-6 * np.abs(want).max()


@pytest.mark.parametrize(("dtype", "bound"), [(np.float64, 1e-12), (np.float32, 1e-5)])
def test_projection_is_linear_in_intensity_with_the_right_adjoint(dtype, bound):
    rng = np.random.default_rng(6)
    for seed in range(20):
        view = carm(96, 1.8, a=rng.uniform(-60, 60), b=rng.uniform(-30, 30))
        g = random_gaussians(30, seed)
        x, y = rng.normal(size=30), rng.normal(size=(96, 96))
        import dataclasses

        made = project(dataclasses.replace(g, intensity=x), view, dtype=dtype)
        back = project_vjp(g, view, y).intensity
        gap = abs(np.sum(made.astype(np.float64) * y) - x @ back)
        assert gap < bound * np.linalg.norm(made) * np.linalg.norm(y)


def test_torch_twin_agrees_in_value_and_gradient():
    torch = pytest.importorskip("torch")
    from gcar_deploy.gaussians.torch_project import torch_project

    view, g = carm(48, 3.7), random_gaussians(7, 8)
    weight = np.random.default_rng(8).normal(size=(48, 48))
    leaves = [
        torch.tensor(a, requires_grad=True)
        for a in (g.means_mm, np.log(g.scales_mm), g.quaternions_wxyz, g.intensity)
    ]
    image = torch_project(*leaves, view)
    np.testing.assert_allclose(image.detach().numpy(), project(g, view, cut_sigmas=9), atol=1e-10)
    (image * torch.from_numpy(weight)).sum().backward()
    grad = project_vjp(g, view, weight, cut_sigmas=9)
    for leaf, own in zip(
        leaves, (grad.means_mm, grad.log_scales, grad.quaternions_wxyz, grad.intensity), strict=True
    ):
        np.testing.assert_allclose(leaf.grad.numpy(), own, atol=1e-9 * np.abs(own).max())


def test_torch_gradcheck_in_double():
    torch = pytest.importorskip("torch")
    from gcar_deploy.gaussians.torch_project import torch_project

    g = random_gaussians(2, 9, spread=10)
    leaves = [
        torch.tensor(a, requires_grad=True)
        for a in (g.means_mm, np.log(g.scales_mm), g.quaternions_wxyz, g.intensity)
    ]
    assert torch.autograd.gradcheck(
        lambda *x: torch_project(*x, carm(16, 10.0)), leaves, eps=1e-6, atol=1e-6, rtol=1e-4
    )


@pytest.mark.slow
def test_against_an_independent_projector():
    """itk-rtk through 0.5 mm voxels, which with Joseph's method limit the agreement."""
    pytest.importorskip("itk")
    from gcar_deploy.gaussians.voxelize import voxelize
    from gcar_export.methods.rtk_geometry import forward

    g = random_gaussians(12, 10, spread=20, sigma=(1.5, 3.0))
    grid = Grid(center_mm=(0, 0, 0), size_mm=(80, 80, 80), shape=(160, 160, 160))
    view = carm(128, 1.4)
    want = np.asarray(forward(voxelize(g, grid), grid, [view])[0])
    got = project(g, view)
    assert np.abs(got - want).max() < 0.02 * want.max()
    assert got.sum() == pytest.approx(want.sum(), rel=3e-3)


def test_behind_the_source_is_left_out_and_gets_no_gradient():
    view = carm()
    behind = view.source_mm - 100 * view.axes[2]
    g = random_gaussians(2, 11)
    both = concatenate(
        [
            g,
            Gaussians(
                means_mm=behind[None],
                scales_mm=np.ones((1, 3)),
                quaternions_wxyz=np.ones((1, 4)),
                intensity=np.ones(1),
            ),
        ]
    )
    np.testing.assert_array_equal(project(both, view), project(g, view))
    grad = project_vjp(both, view, np.ones((128, 128)))
    assert not grad.means_mm[2].any() and not grad.intensity[2]


def test_order_of_gaussians_is_nothing_and_intensity_is_linear():
    view, g = carm(), random_gaussians(30, 12)
    order = np.random.default_rng(0).permutation(30)
    np.testing.assert_allclose(project(g, view), project(g.select(order), view), atol=1e-12)


def test_zero_quaternion_is_the_identity():
    np.testing.assert_array_equal(rotation_matrices(np.zeros((1, 4)))[0], np.eye(3))
    q = np.random.default_rng(0).normal(size=(20, 4))
    R = rotation_matrices(q)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (20, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("means_mm", np.full((2, 3), np.nan), "not finite"),
        ("scales_mm", np.zeros((2, 3)), "above 0"),
        ("intensity", np.ones(3), "has shape"),
        ("quaternions_wxyz", np.full((2, 4), np.inf), "not finite"),
    ],
)
def test_bad_arrays_are_named(name, value, message):
    g = random_gaussians(2)
    arrays = {k: getattr(g, k) for k in ("means_mm", "scales_mm", "quaternions_wxyz", "intensity")}
    with pytest.raises(UsageError, match=f"{name}.*{message}"):
        Gaussians(**{**arrays, name: value})
