"""What goes wrong inside the optimiser: five families of hard cases, six variants each.

Whatever the start, the paper's refiner ends bounded and finite, or says clearly that it cannot.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import PaperOptions
from gcar_deploy.errors import GeometryError, UsageError
from gcar_deploy.gaussians.gaussians import Gaussians
from gcar_deploy.gaussians.paper import LARGEST_SIGMA_MM, MOST_ANISOTROPY, refine_paper
from gcar_deploy.gaussians.project import project
from gcar_deploy.gaussians.voxelize import voxelize
from gcar_deploy.geometry.grid import Grid
from tests.gaussians.test_paper import views_of
from tests.gaussians.test_project import random_gaussians
from tests.hard.phantoms import carm
from tests.tubes.scenes import vessel_image

OPTIONS = PaperOptions(steps=12, control_every=5, most_gaussians=60, pixel_mm=2.0, patience=60)


@pytest.fixture(scope="module")
def views():
    return views_of(random_gaussians(20, 5, spread=20, sigma=(1.5, 2.5)), 32)


def start(**changes):
    """Twenty Gaussians of which the third is changed, field by field."""
    g = random_gaussians(20, 7, spread=20, sigma=(1.0, 3.0))
    arrays = {f.name: getattr(g, f.name) for f in dataclasses.fields(g) if f.name != "sigma_mm"}
    arrays = {name: value.copy() for name, value in arrays.items()}
    for name, value in changes.items():
        arrays[name][3] = value
    return Gaussians(**arrays)


def check(out, options=OPTIONS):
    g = out.gaussians
    assert out.status in ("ok", "failed") and len(g) <= options.most_gaussians
    assert np.isfinite(out.losses).all()
    for array in (g.means_mm, g.scales_mm, g.quaternions_wxyz, g.intensity):
        assert np.isfinite(array).all()
    assert (g.intensity >= 0).all() and g.intensity.max(initial=0.0) < 2e4
    assert g.scales_mm.max() <= LARGEST_SIGMA_MM * (1 + 1e-9)
    slimmest = g.scales_mm.min(axis=1) * MOST_ANISOTROPY
    # Rounding through the sigmoid, and one step after the last cap.
    assert (g.scales_mm.max(axis=1) <= 1.1 * slimmest).all()
    assert not out.losses or min(out.losses) <= out.losses[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "scales",
    [np.exp(-20), np.exp(10), (np.exp(-20), 1, np.exp(10)), (1e-9, 5, 5), (300, 1, 1), 1e30],
)
def test_17_scales_collapse_or_explode(views, scales):
    check(refine_paper(start(scales_mm=scales), views, OPTIONS))


@pytest.mark.slow
@pytest.mark.parametrize("intensity", [1e30, -1.0, 0.0, -1e30, 1e-300, 1e8])
def test_18_intensity_explodes_or_is_negative(views, intensity):
    check(refine_paper(start(intensity=intensity), views, OPTIONS))


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (1e-200, 0, 0, 0), (1e150, 1e150, 0, 0)])
def test_19_quaternions_of_no_or_any_length(views, quaternion):
    check(refine_paper(start(quaternions_wxyz=quaternion), views, OPTIONS))


@pytest.mark.parametrize(
    ("field", "value"), [("means_mm", np.nan), ("scales_mm", np.inf), ("intensity", np.nan)]
)
def test_19_what_is_not_finite_is_refused_by_name(field, value):
    with pytest.raises(UsageError, match=f"{field} holds values that are not finite"):
        start(**{field: value})


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"pull_ratio": 0.0}, {"pull_ratio": 0.0, "control_every": 1}, {"split_pixels": 0.0},
        {"least_mass_share": 1e9}, {"most_gaussians": 5}, {"most_gaussians": 1, "pull_ratio": 0},
    ],
)  # fmt: skip
def test_20_cloning_without_bounds_meets_the_cap(views, changes):
    options = dataclasses.replace(OPTIONS, **changes)
    out = refine_paper(start(), views, options)
    assert len(out.gaussians) <= options.most_gaussians
    if len(out.gaussians):
        check(out, options)


@pytest.mark.slow
@pytest.mark.parametrize(
    "place",
    ["behind the source", "at the source", "behind the detector", "beside the source"],
)
def test_21_gaussians_out_of_the_beam(views, place):
    view = views[0].carm
    d = view.axes[2]
    where = {
        "behind the source": 2 * view.source_mm,
        "at the source": view.source_mm,
        "behind the detector": 2000.0 * d,
        "beside the source": view.source_mm + 400.0 * view.axes[0],
    }[place]
    check(refine_paper(start(means_mm=where), views, OPTIONS))


@pytest.mark.parametrize("changes", [{"sod_mm": 250.0}, {"sdd_mm": 700.0}])
def test_21_sources_and_detectors_that_cannot_be(changes):
    with pytest.raises(GeometryError, match=next(iter(changes))):
        carm(0, 0, **changes)


@pytest.mark.slow
@pytest.mark.parametrize(
    "shape", [(134, 134, 27), (27, 134, 40), (40, 40, 40), (160, 160, 16), (16, 160, 80), (80,) * 3]
)
def test_22_oblong_voxels_keep_the_mass(shape):
    g = random_gaussians(12, 4, spread=12, sigma=(1.2, 2.5))
    grid = Grid(center_mm=(0, 0, 0), size_mm=(80.0,) * 3, shape=shape)
    mass = voxelize(g, grid).sum(dtype=np.float64) * np.prod(grid.spacing_mm)
    assert mass == pytest.approx(g.masses_mm3().sum(), rel=1e-3)


POISONED = PaperOptions(steps=50, control_every=10, most_gaussians=16, pixel_mm=1.0, patience=60)
#: what each kind of poison does to the Gaussians chosen by ``hit``
POISON = {
    "scales e^-20": lambda g, hit: g["scales_mm"].__setitem__(hit, np.exp(-20)),
    "scales e^10": lambda g, hit: g["scales_mm"].__setitem__(hit, np.exp(10)),
    "needles": lambda g, hit: g["scales_mm"].__setitem__(hit, (np.exp(-20), 1, np.exp(10))),
    "zero quaternions": lambda g, hit: g["quaternions_wxyz"].__setitem__(hit, 0.0),
    "huge quaternions": lambda g, hit: g["quaternions_wxyz"].__setitem__(hit, 1e150),
    "intensity 1e30": lambda g, hit: g["intensity"].__setitem__(hit, 1e30),
    "intensity -1e30": lambda g, hit: g["intensity"].__setitem__(hit, -1e30),
    "behind the source": lambda g, hit: g["means_mm"].__setitem__(hit, 2 * SMALL.source_mm),
    "all in one place": lambda g, hit: g["means_mm"].__setitem__(hit, g["means_mm"][0]),
}
SMALL = carm(-30, -20, rows=12, columns=12, pixel_spacing_mm=(8.0, 8.0))


def poisoned(seed, *kinds):
    """Eight Gaussians of which some, at least one, are poisoned."""
    rng = np.random.default_rng(seed)
    g = random_gaussians(8, seed, spread=20, sigma=(1.5, 3.0))
    arrays = {f.name: getattr(g, f.name) for f in dataclasses.fields(g) if f.name != "sigma_mm"}
    arrays = {name: value.copy() for name, value in arrays.items()}
    for kind in kinds:
        POISON[kind](arrays, rng.permutation(8)[: rng.integers(1, 9)])
    return arrays


@pytest.fixture(scope="module")
def small():
    path = project(random_gaussians(8, 5, spread=20, sigma=(1.5, 3.0)), SMALL)
    return [vessel_image(SMALL, path)]


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 200, 20))
def test_200_poisoned_starts_stay_bounded_over_50_steps(small, first):
    kinds = list(POISON)
    for seed in range(first, first + 20):
        # One kind, or from the second round on two at once.
        chosen = sorted({seed % 9, (seed // 9) * (seed % 9) % 9})
        arrays = poisoned(seed, *(kinds[k] for k in chosen))
        out = refine_paper(Gaussians(**arrays), small, POISONED)
        check(out, POISONED)
        assert out.status == "failed" or out.steps + out.rejected_steps == 50


def broken(field, value):
    """Gaussians of which a number broke after they were made."""
    g = random_gaussians(8, 3)
    array = getattr(g, field).copy()
    array[3] = value
    object.__setattr__(g, field, array)
    return g


def test_nan_past_the_door_is_refused_and_inf_is_bounded(small):
    with pytest.raises(UsageError, match="not finite"):
        refine_paper(broken("means_mm", np.nan), small, POISONED)
    check(refine_paper(broken("scales_mm", np.inf), small, POISONED), POISONED)


@pytest.mark.slow
def test_thousands_of_duplicates_over_50_steps(small):
    one = random_gaussians(8, 5, spread=20, sigma=(1.5, 3.0)).select(np.zeros(2000, np.int64))
    options = dataclasses.replace(POISONED, most_gaussians=2000)
    out = refine_paper(one, small, options)
    check(out, options)
    assert out.steps + out.rejected_steps == 50


def test_pictures_of_unknown_scale_find_their_contrast(views):
    truth = random_gaussians(20, 5, spread=20, sigma=(1.5, 2.5))
    scaled = [dataclasses.replace(v, path_mm=1.6 * v.path_mm, path_error=0.25) for v in views]
    out = refine_paper(truth, scaled, dataclasses.replace(OPTIONS, steps=3, control_every=0))
    np.testing.assert_allclose(out.contrast, 1.6, rtol=0.02)
    # Beyond its bounds the factor stays on them.
    bright = [dataclasses.replace(v, path_mm=99 * v.path_mm, path_error=0.25) for v in views]
    assert refine_paper(truth, bright, OPTIONS).contrast == (2.5, 2.5)
