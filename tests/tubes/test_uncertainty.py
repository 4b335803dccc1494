"""Is the stated covariance true? Closed forms of its parts, and errors of whole fits against it."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gcar_deploy.config import TubeOptions
from gcar_deploy.errors import CancelledError
from gcar_deploy.geometry.covariance import worst_sigma
from gcar_deploy.geometry.prior import LEFT_DEG, LEFT_MM
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes import uncertainty
from gcar_deploy.tubes.fit import fit_tubes
from gcar_deploy.tubes.gauss_newton import footprints, normal_equations
from gcar_deploy.tubes.hessian import LEAST_MISFIT, PATCH_MM2, seen_by
from gcar_deploy.tubes.model import tubes_of
from gcar_deploy.tubes.prior import make_prior
from gcar_deploy.tubes.targets import make_targets
from gcar_deploy.tubes.uncertainty import PIXEL_SHARE, spread
from tests.hard.phantoms import distances, helix, seven
from tests.tree.shapes import branch, grid, points_of, tube
from tests.tubes.scenes import carm, seen, two_views

OPTIONS = TubeOptions()
#: a tube that may move but hardly bend, no starting points to hold it, and noise that is told
BARE = TubeOptions(
    noise_mm=0.2, noise_share=0.0, robust_sigmas=1e6, bend=1e-6, taper=1e-3, anchor_mm=1e4,
    anchor_log_radius=1e3, edge_blur_mm=1.0,
)  # fmt: skip
#: residuals of the straight tube, mm, and its length with its caps' worth
LEFT_OVER_MM, LENGTH_MM = 0.15, 60.0 + 1.5


def straight_tube(theta):
    """A vertical tube in two views ``theta`` apart whose pictures leave +-0.15 mm over."""
    truth = tube(length=60.0, radius=1.5, count=61)
    views = [carm(-theta / 2, 0, 192), carm(theta / 2, 0, 192)]
    targets = make_targets(seen(truth, views), 0.0, BARE)
    tubes = tubes_of(truth)
    prior = make_prior(tubes, np.ones(len(tubes.log_radius)), BARE)
    prints = footprints(tubes, targets)
    row, col = np.indices(targets[0].path_mm.shape)
    sign = np.where((row + col) % 2, 1.0, -1.0)
    targets = [
        dataclasses.replace(
            target, path_mm=print_.image(target.path_mm.shape) + LEFT_OVER_MM * sign
        )
        for target, print_ in zip(targets, prints, strict=True)
    ]
    return tubes, targets, prints, prior


def parts_of(tubes, targets, prints, prior, options=BARE):
    along = np.tile([0.0, 0.0, 1.0], (len(tubes.owner), 1))
    views = [
        seen_by(tubes, target, print_, options)
        for target, print_ in zip(targets, prints, strict=True)
    ]
    return spread(tubes, along, views, prior)


def information_per_mm(target):
    """Fisher information of one view on a shift across the tube, 1 / mm^2 per mm of tube.

    The chord 2 sqrt(r^2 - x^2), averaged over the blur, has the slope below; what is left over
    is a noise of its mean square times the patch per mm^2 of picture.
    """
    box, x = target.box_px * target.pixel_mm, np.linspace(-2.5, 2.5, 20001)

    def chord(at):
        return 2 * np.sqrt(np.maximum(1.5**2 - at**2, 0))

    slope = (chord(x + box / 2) - chord(x - box / 2)) / box
    noise = PATCH_MM2 * (LEFT_OVER_MM**2 + LEAST_MISFIT * BARE.noise_mm**2)
    return np.sum(slope**2) * (x[1] - x[0]) / noise


@pytest.mark.parametrize("theta", [30, 60, 90, 120])
def test_depth_and_plane_of_a_rigid_tube_are_the_cramer_rao_bounds(theta):
    """Two views: (1 - cos theta) of one view's information in depth, (1 + cos theta) beside it.

    A straight line through noise has 1 / (L I) in its middle and four times that at its ends.
    """
    tubes, targets, prints, prior = straight_tube(theta)
    fit = parts_of(tubes, targets, prints, prior).fit
    pixel = (PIXEL_SHARE * targets[0].pixel_mm) ** 2
    one = 1.0 / (LENGTH_MM * information_per_mm(targets[0]))
    # The beams' bisector is the y axis, to which both views look alike.
    cosine = np.cos(np.radians(theta))
    for axis, bound in ((1, one / (1 - cosine)), (0, one / (1 + cosine))):
        assert fit[30, axis, axis] - pixel == pytest.approx(bound, rel=0.06)
        assert (fit[0, axis, axis] - pixel) / bound == pytest.approx(4.0, rel=0.1)
    assert abs(fit[30, 0, 1]) < 0.02 * fit[30, 1, 1]
    # Along the tube it may slide, which is no error of the tube.
    assert np.abs(fit[:, 2]).max() < 1e-12 and np.abs(fit[:, :, 2]).max() < 1e-12


def test_white_noise_moves_a_tube_by_the_inverse_of_the_hessian():
    """Steps of the fit scatter by the stated covariance, were each pixel a patch of its own."""
    tubes, targets, prints, prior = straight_tube(60)
    clean = [print_.image(t.path_mm.shape) for print_, t in zip(prints, targets, strict=True)]
    rng, shifts, noise_mm = np.random.default_rng(0), [], 0.3
    for _ in range(80):
        noisy = [
            dataclasses.replace(target, path_mm=image + rng.normal(0, noise_mm, image.shape))
            for image, target in zip(clean, targets, strict=True)
        ]
        hessian, gradient = normal_equations(tubes, noisy, prints, prior, BARE)
        step = hessian.damped(0.0, 1e-9).factorised().solve(-gradient)
        shifts.append(step[: 3 * len(tubes.positions_mm)].reshape(-1, 3)[tubes.owner[30], :2])
    stated = parts_of(tubes, noisy, prints, prior).fit[30]
    stated = stated[:2, :2] - (PIXEL_SHARE * targets[0].pixel_mm) ** 2 * np.eye(2)
    white = noise_mm**2 * targets[0].pixel_mm ** 2
    stated *= white / (PATCH_MM2 * (noise_mm**2 + LEAST_MISFIT * BARE.noise_mm**2))
    for axis in (0, 1):
        assert np.mean(np.square(shifts), axis=0)[axis] == pytest.approx(
            stated[axis, axis], rel=0.4
        )


@pytest.mark.parametrize("theta", [30, 60, 90, 140])
def test_geometry_of_a_lone_tube_at_the_isocentre(theta):
    """Only the table moves it: what view 2 sees across it, over sin(theta), along beam 1."""
    tubes, targets, prints, prior = straight_tube(theta)
    geometry = parts_of(tubes, targets, prints, prior).geometry[30]
    expected = LEFT_MM / np.sin(np.radians(theta))
    assert worst_sigma(geometry[None])[0] == pytest.approx(expected, rel=0.04)
    beam = targets[0].carm.axes[2]
    assert np.sqrt(beam @ geometry @ beam) == pytest.approx(expected, rel=0.04)


def test_geometry_that_the_pictures_would_notice_is_not_left_open():
    """Across the planes of both beams the views see the same thing: a bar there stays put."""
    line = np.stack([np.linspace(-20, 20, 41), np.zeros(41), np.zeros(41)], 1)
    bent = line + 6.0 * np.sin(line[:, :1] / 6.0) * np.array([0.0, 0.0, 1.0])
    truth = Tree(nodes_mm=bent[[0, -1]], branches=(branch(bent, 1.5),))
    targets = make_targets(seen(truth, [carm(-45, 0, 192), carm(45, 0, 192)]), 0.0, BARE)
    tubes = tubes_of(truth)
    views = [
        seen_by(tubes, target, print_, BARE)
        for target, print_ in zip(targets, footprints(tubes, targets), strict=True)
    ]
    prior = make_prior(tubes, np.ones(len(tubes.log_radius)), BARE)
    geometry = spread(tubes, truth.branches[0].tangents, views, prior).geometry
    crest = np.argmax(bent[:, 2])  # runs in the plane: what is across it is z and depth
    assert np.sqrt(geometry[crest, 2, 2]) < 0.3 * LEFT_MM
    assert np.sqrt(geometry[crest, 1, 1]) > 0.6 * LEFT_MM


def test_where_vessels_overlap_more_is_open():
    """Two bars side by side in one view, apart in the other: less is known of both there."""
    line = np.stack([np.zeros(31), np.zeros(31), np.linspace(-15, 15, 31)], 1)
    other = line + np.array([1.0, 14.0, 0.0])

    def at_the_middle(pieces):
        nodes = np.concatenate([piece.points_mm[[0, -1]] for piece in pieces])
        pieces = [
            dataclasses.replace(piece, start=2 * k, end=2 * k + 1) for k, piece in enumerate(pieces)
        ]
        tree = Tree(nodes_mm=nodes, branches=tuple(pieces))
        tubes = tubes_of(tree)
        targets = make_targets(seen(tree, [carm(0, 0, 128, 0.8), carm(90, 0, 128, 0.8)]), 0, BARE)
        prior = make_prior(tubes, np.ones(len(tubes.log_radius)), BARE)
        return parts_of(tubes, targets, footprints(tubes, targets), prior).fit[15] - (
            (PIXEL_SHARE * targets[0].pixel_mm) ** 2 * np.diag([1.0, 1.0, 0.0])
        )

    alone = at_the_middle([branch(line, 1.2)])
    beside = at_the_middle([branch(line, 1.2), branch(other, 1.2)])
    assert beside[0, 0] > 2 * alone[0, 0]  # seen by the view in which they overlap
    assert beside[1, 1] == pytest.approx(alone[1, 1], rel=0.3)


def axes_at(points, told):
    """(n, 2, 3) normal of the epipolar plane and the bisector of both rays, unit vectors."""
    rays = [points - view.source_mm for view in told]
    rays = [ray / np.linalg.norm(ray, axis=1)[:, None] for ray in rays]
    both = np.stack([np.cross(*rays), rays[0] + rays[1]], axis=1)
    return both / np.linalg.norm(both, axis=2)[:, :, None]


@pytest.mark.slow
def test_errors_of_whole_fits_are_those_that_sigma_states():
    """Pictures by the oracle, view 2 off by draws from the stated prior, noise on the paths.

    Over 16 fits the mean of (error / sigma)^2 lies near 1, in depth by itself as well: half the
    sigma is caught.
    """
    told, z, depth = two_views(128, 1.2), [], []
    for tree, noise_mm in ((seven(), 0.0), (helix(), 0.3)):
        centers = points_of(tree, grid(80))
        dense = np.concatenate([b.points_mm for b in tree.branches])
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
            points = fitted.points()
            covariance = np.concatenate([b.covariance_mm2 for b in fitted.branches]).sum(axis=1)
            np.testing.assert_allclose(sigma, worst_sigma(covariance))
            depth.append(_along_depth(points, dense, covariance, fitted, told))
    together = np.concatenate(z)

    assert 0.5 < np.mean(together**2) < 1.7
    assert 0.92 < np.mean(together < 1.96) < 0.999
    assert 0.5 < np.mean(np.concatenate(depth) ** 2) < 1.7


def _along_depth(points, dense, covariance, fitted, told):
    """Error over sigma along the bisector of the beams, where the vessel runs across it."""
    off = points - dense[cKDTree(dense).query(points)[1]]
    tangents = np.concatenate([b.tangents for b in fitted.branches])
    axis = axes_at(points, told)[:, 1]
    axis = axis - np.einsum("ni,ni->n", axis, tangents)[:, None] * tangents
    size = np.linalg.norm(axis, axis=1)
    axis = axis / size[:, None]
    spread_ = np.sqrt(np.einsum("ni,nij,nj->n", axis, covariance, axis))
    return (np.einsum("ni,ni->n", off, axis) / spread_)[size > 0.7]


def test_a_large_scene_counts_vessels_that_share_rays_as_known(monkeypatch):
    """What meets at a fork stays coupled; the rest of the couplings hardly counts."""
    truth = seven()
    targets = make_targets(seen(truth, two_views(128, 1.2)), 0.0, OPTIONS)
    tubes = tubes_of(truth)
    prior = make_prior(tubes, np.ones(len(tubes.log_radius)), OPTIONS)
    told = [
        seen_by(tubes, target, print_, OPTIONS)
        for target, print_ in zip(targets, footprints(tubes, targets), strict=True)
    ]
    along = np.concatenate([one.tangents for one in truth.branches])
    whole = spread(tubes, along, told, prior)
    monkeypatch.setattr(uncertainty, "MOST_ENTRIES", 0)
    within = spread(tubes, along, told, prior)
    assert (within.fit != whole.fit).any()
    ratio = worst_sigma(within.fit) / worst_sigma(whole.fit)
    assert 0.95 < np.median(ratio) < 1.05 and np.quantile(ratio, 0.05) > 0.8
    # One that is late is not waited for, one that is cancelled ends within.
    monkeypatch.undo()
    late = spread(tubes, along, told, prior, lambda: True)
    np.testing.assert_array_equal(late.fit, within.fit)
    asked = []

    def cancelled():
        asked.append(1)
        if len(asked) > 3:
            raise CancelledError("enough")
        return False

    with pytest.raises(CancelledError):
        spread(tubes, along, told, prior, cancelled)
    assert len(asked) == 4
