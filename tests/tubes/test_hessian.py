"""The true Hessian of the tube fit: against sums over pixels, and against finite differences."""

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import TubeOptions
from gcar_deploy.tree.tree import Tree
from gcar_deploy.tubes.gauss_newton import footprints, normal_equations, unknowns
from gcar_deploy.tubes.hessian import CROSSED, LEAST_MISFIT, PATCH_MM2, misfit, seen_by
from gcar_deploy.tubes.model import tubes_of
from gcar_deploy.tubes.prior import make_prior
from gcar_deploy.tubes.targets import make_targets
from tests.tree.shapes import branch
from tests.tubes.scenes import carm, seen, two_views

OPTIONS = TubeOptions()
FLOOR = PATCH_MM2 * LEAST_MISFIT


def crossed(gap=12.0):
    """Two bars that cross in the first view, ``gap`` mm apart along its beam."""
    one = np.stack([np.linspace(-9, 9, 10), np.zeros(10), np.linspace(-6, 6, 10)], 1)
    two = np.stack([np.linspace(-9, 9, 10), np.full(10, gap), np.linspace(6, -6, 10)], 1)
    nodes = np.concatenate([one[[0, -1]], two[[0, -1]]])
    pieces = (branch(one, 1.4), dataclasses.replace(branch(two, 1.2), start=2, end=3))
    return Tree(nodes_mm=nodes, branches=pieces)


def at_the_fit(tree, carms):
    """Tubes, and targets that hold just what the model shows: nothing is left over."""
    tubes = tubes_of(tree)
    targets = make_targets(seen(tree, carms), 0.0, OPTIONS)
    prints = footprints(tubes, targets)
    targets = [
        dataclasses.replace(target, path_mm=print_.image(target.path_mm.shape))
        for target, print_ in zip(targets, prints, strict=True)
    ]
    return tubes, targets, prints


def weight(target, print_):
    """(rows * cols,) what each pixel counts at a fit that leaves nothing over."""
    many = np.bincount(print_.pixel, print_.path_mm > 0, minlength=target.path_mm.size)
    return (
        (target.pixel_mm / target.sigma_mm.reshape(-1)) ** 2
        / FLOOR
        / np.where(many > 1, CROSSED, 1.0)
    )


def test_a_pixel_is_one_equation_for_all_that_cross_it():
    tubes, targets, prints = at_the_fit(crossed(), two_views(96, 1.3))
    p3 = 3 * len(tubes.positions_mm)
    for target, print_ in zip(targets, prints, strict=True):
        by_pixel = target.carm.jacobian(tubes.points_mm)
        rows = np.zeros((target.path_mm.size, p3 + len(tubes.owner)))
        for k, pixel in enumerate(print_.pixel):
            s, t = print_.segment[k], print_.t[k]
            for point, share in ((tubes.first[s], 1 - t), (tubes.second[s], t)):
                at = 3 * tubes.owner[point]
                slope = share * (print_.d_axis[:, k] @ by_pixel[point])
                rows[pixel, at : at + 3] += slope
                rows[pixel, p3 + point] += share * print_.d_log_radius[k]
        expected = rows.T @ (weight(target, print_)[:, None] * rows)
        found = seen_by(tubes, target, print_, OPTIONS).hessian().toarray()
        np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_hessian_is_that_of_finite_differences():
    """Bars that cross a view: the coupling between them is as the pictures have it.

    The tolerance is for what the derivatives hold fixed: the angle to the ray, and which segment a
    pixel is nearest to.
    """
    carms = [carm(0, 0, 96, 1.3), carm(60, 10, 96, 1.3)]
    tubes, targets, prints = at_the_fit(crossed(), carms)
    p, h = len(tubes.positions_mm), 1e-4
    x0 = unknowns(tubes)

    def images(x):
        moved = dataclasses.replace(
            tubes, positions_mm=x[: 3 * p].reshape(-1, 3), log_radius=x[3 * p :]
        )
        return [
            print_.image(target.path_mm.shape).reshape(-1)
            for print_, target in zip(footprints(moved, targets), targets, strict=True)
        ]

    columns = [[], []]
    for k in range(len(x0)):
        step = np.zeros(len(x0))
        step[k] = h
        for view, (up, down) in enumerate(zip(images(x0 + step), images(x0 - step), strict=True)):
            columns[view].append((up - down) / (2 * h))
    inner = np.setdiff1d(np.arange(3 * p), np.arange(12))  # ends have caps
    for target, print_, by_unknown in zip(targets, prints, columns, strict=True):
        J = np.stack(by_unknown, axis=1)
        expected = (J.T @ (weight(target, print_)[:, None] * J))[np.ix_(inner, inner)]
        found = seen_by(tubes, target, print_, OPTIONS).hessian().toarray()[np.ix_(inner, inner)]
        assert np.linalg.norm(found - expected) < 0.12 * np.linalg.norm(expected)
    # In the first view the bars cross: what couples them is the pictures' doing alone.
    half = len(inner) // 2
    found = seen_by(tubes, targets[0], prints[0], OPTIONS).hessian().toarray()
    J = np.stack(columns[0], axis=1)
    expected = J.T @ (weight(targets[0], prints[0])[:, None] * J)
    block = np.ix_(inner[:half], inner[half:])
    assert np.abs(expected[block]).max() > 1e-3
    assert np.linalg.norm((found - expected)[block]) < 0.15 * np.linalg.norm(expected[block])


def test_the_steps_matrix_is_never_smaller():
    """What the fit steps with bounds the true one from above, and is larger at the crossing."""
    tubes, targets, prints = at_the_fit(crossed(), two_views(96, 1.3))
    prior = make_prior(tubes, np.ones(len(tubes.log_radius)), OPTIONS)
    bound = normal_equations(tubes, targets, prints, prior, OPTIONS)[0].dense()
    bound -= (prior.A.T @ prior.A).toarray()
    true = np.zeros_like(bound)
    for target, print_ in zip(targets, prints, strict=True):
        plain = dataclasses.replace(print_, crossings=np.ones_like(print_.crossings))
        true += FLOOR * seen_by(tubes, target, plain, OPTIONS).hessian().toarray()
    gap = np.linalg.eigvalsh(bound - true)
    assert gap[0] > -1e-9 * gap[-1] and gap[-1] > 0.1 * np.linalg.eigvalsh(true)[-1]


def test_a_moved_view_pulls_as_moved_points_do():
    """The gradient of a view that stands elsewhere: H times a move of all points, in its terms."""
    tubes, targets, prints = at_the_fit(crossed(), two_views(96, 1.3))
    view = seen_by(tubes, targets[1], prints[1], OPTIONS)
    shift = np.array([0.3, -0.2, 0.4])
    pixels = np.einsum("nij,j->ni", view.carm.jacobian(tubes.points_mm), shift)
    pull, own = view.pull([pixels])
    move = np.zeros(pull.shape[0])
    move[: 3 * len(tubes.positions_mm)] = np.tile(shift, len(tubes.positions_mm))
    np.testing.assert_allclose(pull[:, 0], view.hessian() @ move, rtol=1e-9, atol=1e-12)
    assert own[0, 0] == pytest.approx(move @ (view.hessian() @ move))


def test_misfit_is_local_and_as_large_as_what_is_left_over():
    tubes, targets, prints = at_the_fit(crossed(), two_views(96, 1.3))
    target, print_ = targets[0], prints[0]
    left = np.where(tubes.branch[print_.segment] == 0, 0.3, 0.0)
    found = misfit(tubes, target, print_, left)
    alone = (print_.crossings == 1) & (print_.path_mm > 0)
    z2 = (0.3 / target.sigma_mm.reshape(-1)[print_.pixel]) ** 2
    one = alone & (left > 0)
    assert found[one].min() > PATCH_MM2 * (z2[one].min() + LEAST_MISFIT) * 0.999
    assert found[one].max() < PATCH_MM2 * (z2[one].max() + LEAST_MISFIT) * 1.001
    np.testing.assert_allclose(found[alone & (left == 0)], FLOOR)
    # Who is to blame where both are: the worse of them, and the crossing.
    both = found[(print_.crossings > 1) & (print_.path_mm > 0)]
    assert len(both) and (both >= CROSSED * PATCH_MM2 * (z2.min() + LEAST_MISFIT)).all()


def test_what_a_mask_hides_leaves_open_which_tube_it_shows():
    tubes = tubes_of(crossed())
    target = dataclasses.replace(
        make_targets(seen(crossed(), [carm(0, 0, 96, 1.3)]), 0.0, OPTIONS)[0], shown="width"
    )
    (print_,) = footprints(tubes, [target])
    told = misfit(tubes, target, print_, np.zeros(len(print_.pixel)))
    both = np.bincount(print_.pixel)[print_.pixel] > 1
    assert both.any() and not both.all()
    assert print_.crossings[both].max() == 1
    assert told[both] == pytest.approx(FLOOR * CROSSED)
    assert told[~both] == pytest.approx(FLOOR)
