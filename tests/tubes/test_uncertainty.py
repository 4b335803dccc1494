"""Is the stated sigma true? Closed forms of its parts, and errors of whole fits against it."""

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import TubeOptions
from gcar_deploy.geometry.epipolar import triangulate
from gcar_deploy.geometry.prior import LEFT_DEG, LEFT_MM
from gcar_deploy.tubes.fit import fit_tubes
from gcar_deploy.tubes.gauss_newton import footprints, normal_equations
from gcar_deploy.tubes.model import tubes_of
from gcar_deploy.tubes.prior import make_prior
from gcar_deploy.tubes.targets import make_targets
from gcar_deploy.tubes.uncertainty import CORRELATED_PIXELS, fit_sigma, geometry_sigma
from tests.hard.phantoms import distances, helix, seven
from tests.tree.shapes import grid, points_of, tube
from tests.tubes.scenes import carm, seen, two_views

OPTIONS = TubeOptions()
#: white noise alone, a tube that may move but hardly bend, and no starting points to hold it
BARE = TubeOptions(
    noise_mm=0.2, noise_share=0.0, robust_sigmas=1e6, bend=1e-6, taper=1e-3, anchor_mm=1e4,
    anchor_log_radius=1e3, edge_blur_mm=1.0,
)  # fmt: skip


def straight_fit():
    """Normal equations at the truth of a vertical tube in two views 90 deg apart."""
    truth = tube(length=60.0, radius=1.5, count=61)
    views = [carm(0, 0, 192), carm(90, 0, 192)]
    targets = make_targets(seen(truth, views), 0.0, BARE)
    tubes = tubes_of(truth)
    prior = make_prior(tubes, np.ones(len(tubes.log_radius)), BARE)
    return tubes, targets, prior


def information_per_mm(targets):
    """Fisher information of one view on a shift across the tube, 1 / mm^2 per mm of tube.

    The chord 2 sqrt(r^2 - x^2), averaged over the blur, has the slope below; a mm^2 of
    picture has the noise ``noise_mm``.
    """
    box, x = targets[0].box_px * targets[0].pixel_mm, np.linspace(-2.5, 2.5, 20001)

    def chord(at):
        return 2 * np.sqrt(np.maximum(1.5**2 - at**2, 0))

    slope = (chord(x + box / 2) - chord(x - box / 2)) / box
    return np.sum(slope**2) * (x[1] - x[0]) / BARE.noise_mm**2


def test_fit_sigma_is_the_cramer_rao_bound_of_a_rigid_tube():
    tubes, targets, prior = straight_fit()
    hessian, _ = normal_equations(tubes, targets, footprints(tubes, targets), prior, BARE)
    along = np.tile([0.0, 0.0, 1.0], (len(tubes.positions_mm), 1))
    sigma = fit_sigma(hessian, tubes.owner, along)[tubes.owner]
    # A straight line through noise: 1 / (L I) in the middle, four times that at its ends. The
    # caps, a sphere's worth at each end, lengthen the tube a little.
    bound = np.sqrt(CORRELATED_PIXELS / ((60.0 + 1.5) * information_per_mm(targets)))
    assert sigma[30] == pytest.approx(bound, rel=0.05)
    assert sigma[0] / sigma[30] == pytest.approx(2.0, rel=0.05)


def test_white_noise_moves_a_tube_by_the_bound():
    tubes, targets, prior = straight_fit()
    prints = footprints(tubes, targets)
    clean = [print_.image(t.path_mm.shape) for print_, t in zip(prints, targets, strict=True)]
    rng, shifts = np.random.default_rng(0), []
    for _ in range(60):
        noisy = [
            dataclasses.replace(
                t, path_mm=image + rng.normal(0, BARE.noise_mm / t.pixel_mm, image.shape)
            )
            for image, t in zip(clean, targets, strict=True)
        ]
        hessian, gradient = normal_equations(tubes, noisy, prints, prior, BARE)
        step = hessian.damped(0.0, 1e-9).factorised().solve(-gradient)
        shifts.append(step[: 3 * len(tubes.positions_mm)].reshape(-1, 3)[tubes.owner[30], :2])
    bound = 1 / np.sqrt((60.0 + 1.5) * information_per_mm(targets))
    assert np.sqrt(np.mean(np.square(shifts))) == pytest.approx(bound, rel=0.2)


@pytest.mark.parametrize("theta", [30, 60, 90, 140])
def test_geometry_sigma_of_the_isocentre(theta):
    """Only the table moves it: across view 2 by 1 / sin(theta), along the axis by a half."""
    sigma = geometry_sigma(np.zeros((1, 3)), [carm(0, 0), carm(theta, 0)])
    expected = LEFT_MM * np.hypot(1 / np.sin(np.radians(theta)), 0.5)
    assert sigma[0] == pytest.approx(expected, rel=1e-3)


def test_geometry_sigma_is_how_far_triangulated_points_scatter():
    rng, told = np.random.default_rng(1), two_views()
    points = rng.uniform(-40, 40, (50, 3))
    squares = []
    for _ in range(200):
        turn, shift = rng.normal(0, LEFT_DEG, 2), rng.normal(0, LEFT_MM, 3)
        real = [told[0], told[1].turned(*turn).moved(shift)]
        found = triangulate(told, [view.project(points)[0] for view in real])[0]
        squares.append(np.sum((found - points) ** 2, axis=1))
    stated = geometry_sigma(points, told)
    assert np.sqrt(np.mean(squares)) == pytest.approx(np.sqrt(np.mean(stated**2)), rel=0.1)


def test_errors_of_whole_fits_are_those_that_sigma_states():
    """Pictures by the oracle, view 2 off by draws from the stated prior, noise on the paths.

    Over 16 fits the mean of (error / sigma)^2 lies near 1: half or twice the sigma is caught.
    """
    told, z = two_views(128, 1.2), []
    for tree, noise_mm in ((seven(), 0.0), (helix(), 0.3)):
        centers = points_of(tree, grid(80))
        for seed in range(8):
            rng = np.random.default_rng([seed, len(tree.branches)])
            turn = rng.normal(0, LEFT_DEG, 2)
            shift = rng.normal(0, LEFT_MM, 3)
            pictures = seen(tree, [told[0], told[1].turned(*turn).moved(shift)])
            views = [
                dataclasses.replace(
                    picture,
                    carm=carm_,
                    path_mm=picture.path_mm
                    + (noise_mm * rng.normal(size=picture.path_mm.shape) * picture.mask).astype(
                        np.float32
                    ),
                )
                for picture, carm_ in zip(pictures, told, strict=True)
            ]
            fitted = fit_tubes(centers, views, OPTIONS).tree
            error, sigma = distances(fitted, tree)
            z.append(error / sigma)
            # No point is surer than the pixel and the stated geometry allow.
            pixel = 0.45 * told[0].pixel_at_isocenter_mm
            geometry = geometry_sigma(fitted.points(), told)
            assert (sigma >= 0.999 * np.hypot(pixel, geometry)).all()
    together = np.concatenate(z)
    assert 0.5 < np.mean(together**2) < 1.7
    assert 0.92 < np.mean(together < 1.96) < 0.999
