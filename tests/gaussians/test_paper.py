"""The paper's refinement: it fits, it keeps its bounds, and nothing poisons it."""

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import PaperOptions
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.gaussians.gaussians import Gaussians
from gcar_deploy.gaussians.loss import projection_loss
from gcar_deploy.gaussians.paper import initial_gaussians, refine_paper
from gcar_deploy.gaussians.project import project
from gcar_deploy.imaging.angiogram import VesselImage
from tests.gaussians.test_project import carm, random_gaussians

OPTIONS = PaperOptions(steps=40, control_every=15, most_gaussians=120, pixel_mm=2.0)


def views_of(g, size=64):
    out = []
    for k, (a, b) in enumerate(((-30.0, -20.0), (45.0, 25.0))):
        c = carm(size, 179.2 / size, a, b)
        path = project(g, c).astype(np.float32)
        mask = path > 0.3
        out.append(
            VesselImage(
                view_id=str(k),
                carm=c,
                path_mm=path,
                path_error=0.0,
                mask=mask,
                skeleton=path > 0.9 * path.max(),
                valid=np.ones_like(mask),
                kind="path_length",
                vesselness=None,
            )
        )
    return out


def points(g, noise, seed=0):
    rng = np.random.default_rng(seed)
    n = len(g)
    return CenterPoints(
        points_mm=g.means_mm + noise * rng.normal(size=(n, 3)),
        confidence=np.ones(n),
        radius_mm=np.full(n, np.nan),
        spacing_mm=3.0,
        source="hull",
    )


@pytest.mark.req("REQ-43")
def test_loss_and_its_gradient():
    rng = np.random.default_rng(0)
    made, picture = rng.random((9, 11)), rng.random((9, 11)).astype(np.float32)
    skeleton = rng.random((9, 11)) > 0.8
    valid = np.ones_like(skeleton)
    loss, grad = projection_loss(made, picture, skeleton, valid, 0.5)
    r = made - picture
    assert loss == pytest.approx(0.5 * np.sum(r**2) + 0.5 * np.sum(r[skeleton] ** 2))
    step = 1e-6 * rng.normal(size=made.shape)
    up = projection_loss(made + step, picture, skeleton, valid, 0.5)[0]
    down = projection_loss(made - step, picture, skeleton, valid, 0.5)[0]
    assert up - down == pytest.approx(2 * np.sum(grad * step), rel=1e-4)
    # No skeleton, no division by nothing.
    assert np.isfinite(projection_loss(made, picture, np.zeros_like(skeleton), valid, 0.5)[0])
    # Behind the collimator nothing pulls, and what is there does not count.
    valid[:, :4] = False
    loss, grad = projection_loss(made, picture, skeleton, valid, 0.5)
    seen = skeleton & valid
    assert loss == pytest.approx(0.5 * np.sum(r[valid] ** 2) + 0.5 * np.sum(r[seen] ** 2))
    assert not grad[:, :4].any() and grad[:, 4:].all()
    loss, grad = projection_loss(made, picture, skeleton, np.zeros_like(valid), 0.5)
    assert loss == 0 and not grad.any()


def test_refinement_lowers_the_loss_and_keeps_the_cap():
    truth = random_gaussians(40, 1, spread=20, sigma=(1.5, 2.5))
    out = refine_paper(points(truth, 1.0), views_of(truth), OPTIONS)
    assert out.status == "ok" and out.rejected_steps == 0
    assert min(out.losses) < 0.3 * out.losses[0]
    assert len(out.gaussians) <= OPTIONS.most_gaussians


def test_same_input_same_bytes():
    truth = random_gaussians(25, 2, spread=20, sigma=(1.5, 2.5))
    a, b = (refine_paper(points(truth, 1.0), views_of(truth), OPTIONS) for _ in range(2))
    assert a.gaussians.means_mm.tobytes() == b.gaussians.means_mm.tobytes()
    assert a.losses == b.losses


def test_initial_mass_is_that_of_the_points():
    p = points(random_gaussians(30, 3), 0.0)
    p = dataclasses.replace(p, confidence=np.linspace(0, 1, 30))
    g = initial_gaussians(p, PaperOptions(least_confidence=0.5))
    assert len(g) == (p.confidence >= 0.5).sum()
    np.testing.assert_allclose(g.masses_mm3(), p.confidence[p.confidence >= 0.5] * 27.0)
    assert len(initial_gaussians(p, PaperOptions(most_gaussians=4))) == 4


def test_thinned_start_keeps_mass_centre_and_distance():
    cell = np.stack(np.meshgrid(np.arange(30), np.arange(3), np.arange(3), indexing="ij"), -1)
    p = points(random_gaussians(270, 3), 0.0)
    confidence = np.random.default_rng(0).uniform(0.5, 1, 270)
    p = dataclasses.replace(p, points_mm=3.0 * cell.reshape(-1, 3), confidence=confidence)
    everything = initial_gaussians(p, PaperOptions())
    thin = initial_gaussians(p, PaperOptions(thin_cells=1.1))
    assert len(thin) < 0.55 * len(everything) == 0.55 * 270
    for g in (everything, thin):
        mass = g.masses_mm3()
        assert mass.sum() == pytest.approx(27 * confidence.sum())
        np.testing.assert_allclose(mass @ g.means_mm, 27 * confidence @ p.points_mm)
    # Points in one place, and points nobody believes in, divide by nothing.
    same = dataclasses.replace(p, points_mm=np.zeros((270, 3)), confidence=np.zeros(270))
    for options in (PaperOptions(), PaperOptions(thin_cells=1.1)):
        options = dataclasses.replace(options, least_confidence=0.0)
        assert np.isfinite(initial_gaussians(same, options).masses_mm3()).all()
    nothing = dataclasses.replace(p, confidence=np.zeros(270))
    assert len(initial_gaussians(nothing, PaperOptions(thin_cells=1.1))) == 0


@pytest.mark.req("REQ-22")
def test_numbers_that_are_not_finite_end_the_run_after_five_rejected_steps():
    truth = random_gaussians(10, 6, sigma=(1.5, 2.5))
    views = views_of(truth)
    views[1].path_mm[3, 4] = np.nan
    out = refine_paper(points(truth, 1.0), views, dataclasses.replace(OPTIONS, pixel_mm=0.1))
    assert (out.status, out.steps, out.rejected_steps) == ("failed", 0, 5)
    assert np.isfinite(out.gaussians.means_mm).all()


def test_nothing_to_refine_is_no_error():
    truth = random_gaussians(10, 6, sigma=(1.5, 2.5))
    out = refine_paper(points(truth, 0.0).select(np.zeros(10, bool)), views_of(truth), OPTIONS)
    assert len(out.gaussians) == 0 and np.isfinite(out.losses).all()


def test_caller_can_stop_at_any_step():
    truth = random_gaussians(10, 4, sigma=(1.5, 2.5))
    asked = []
    out = refine_paper(
        points(truth, 1.0),
        views_of(truth),
        OPTIONS,
        should_stop=lambda: asked.append(1) or len(asked) > 3,
    )
    assert out.status == "stopped" and out.steps == 3


def poisoned(kind, rng):
    g = random_gaussians(20, int(rng.integers(1000)), spread=25)
    arrays = {
        "means_mm": g.means_mm,
        "scales_mm": g.scales_mm,
        "quaternions_wxyz": g.quaternions_wxyz,
        "intensity": g.intensity,
    }
    i = rng.integers(20)
    if kind == "tiny":
        arrays["scales_mm"][i] = np.exp(-20)
    elif kind == "huge":
        arrays["scales_mm"][i] = np.exp(10)
    elif kind == "zero quaternion":
        arrays["quaternions_wxyz"][i] = 0
    elif kind == "behind":
        arrays["means_mm"][i] = 2 * carm().source_mm
    elif kind == "bright":
        arrays["intensity"][i] = 1e30
    elif kind == "negative":
        arrays["intensity"][i] = -1.0
    elif kind == "duplicates":
        arrays = {k: np.repeat(v[:1], 300, axis=0) for k, v in arrays.items()}
    return Gaussians(**arrays)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    ["tiny", "huge", "zero quaternion", "behind", "bright", "negative", "duplicates", "none"],
)
def test_poisoned_starts_stay_finite_and_bounded(kind):
    rng = np.random.default_rng(len(kind))
    views = views_of(random_gaussians(20, 5, spread=20, sigma=(1.5, 2.5)), 32)
    options = dataclasses.replace(OPTIONS, steps=25, most_gaussians=400, patience=60)
    for _ in range(25):
        out = refine_paper(poisoned(kind, rng), views, options)
        g = out.gaussians
        assert out.status in ("ok", "failed") and len(g) <= 400
        for a in (g.means_mm, g.scales_mm, g.quaternions_wxyz, g.intensity):
            assert np.isfinite(a).all()
        if out.losses:
            assert min(out.losses) <= out.losses[0]


@pytest.mark.req("REQ-43")
@pytest.mark.parametrize(("alpha", "ratio"), [(0.5, 2.0), (1.0, 1.0), (0.8, 1.25), (0.25, 4.0)])
def test_a_pixel_of_the_skeleton_weighs_one_over_alpha_of_another(alpha, ratio):
    """As printed, alpha = 0.5: twice as much, however many pixels there are of either kind."""
    for shape in ((8, 10), (128, 128)):
        skeleton, valid = np.zeros(shape, bool), np.ones(shape, bool)
        skeleton[3] = True
        on, off = (np.zeros(shape) for _ in range(2))
        on[3, 2], off[5, 2] = 1.0, 1.0
        nothing = np.zeros(shape, np.float32)
        loss_on, grad_on = projection_loss(on, nothing, skeleton, valid, alpha)
        loss_off, grad_off = projection_loss(off, nothing, skeleton, valid, alpha)
        assert loss_on / loss_off == pytest.approx(ratio)
        assert grad_on[3, 2] / grad_off[5, 2] == pytest.approx(ratio)
        assert loss_off == pytest.approx(alpha)
