"""The paper's losses: their values in closed form, and every edge where the printed ones break."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from gcar_export.training.losses import (
    PAPER_START,
    chamfer,
    chamfer_weight,
    depth_loss,
    silog,
    skeleton_dice_loss,
    soft_skeleton,
    splat,
)


@pytest.mark.parametrize(
    ("schedule", "expected"),
    [
        ("clamp", (0, 0, 0, 0, 2 * math.log(20_001 / 20_000), 2 * math.log(5))),
        (
            "shifted",
            (
                0,
                2 * math.log(1.00005),
                2 * math.log(1.99995),
                2 * math.log(2),
                None,
                2 * math.log(6),
            ),
        ),
        ("decaying", (2 * math.log(20_000), 2 * math.log(20_000), None, 0, 0, 0)),
    ],
)
def test_chamfer_weight_is_never_negative_nor_infinite(schedule, expected):
    steps = (0, 1, 19_999, 20_000, 20_001, 100_000)
    found = [chamfer_weight(k, PAPER_START, schedule) for k in steps]
    assert all(0 <= w < 30 for w in found)
    for w, e in zip(found, expected, strict=True):
        assert e is None or w == pytest.approx(e, abs=1e-12)


@pytest.mark.parametrize("bad", [{"schedule": "linear"}, {"start": 0}])
def test_chamfer_weight_names_what_is_wrong(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        chamfer_weight(5, **bad)


def test_chamfer_equals_trees():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(70, 3)), rng.normal(size=(50, 3))
    expected = np.mean(cKDTree(b).query(a)[0] ** 2) + np.mean(cKDTree(a).query(b)[0] ** 2)
    assert float(chamfer(torch.tensor(a), torch.tensor(b))) == pytest.approx(expected, rel=1e-12)


def test_chamfer_of_a_shifted_set_in_closed_form_with_its_gradient():
    line = torch.zeros(9, 3, dtype=torch.float64)
    line[:, 0] = torch.arange(9)
    moved = (line + torch.tensor([0.0, 0.3, 0.0])).requires_grad_()
    loss = chamfer(moved, line)
    loss.backward()
    assert loss.item() == pytest.approx(2 * 0.09)
    torch.testing.assert_close(moved.grad[:, 1], torch.full((9,), 2 * 2 * 0.3 / 9).double())


def test_chamfer_of_equal_sets_is_zero_and_smooth():
    points = torch.rand(20, 3, requires_grad=True)
    loss = chamfer(points, points.detach().clone())
    loss.backward()
    assert loss.item() == 0 and torch.equal(points.grad, torch.zeros_like(points))


@pytest.mark.parametrize("sizes", [(0, 5), (5, 0), (0, 0)])
def test_chamfer_of_an_empty_set_is_undefined(sizes):
    assert chamfer(torch.zeros(sizes[0], 3), torch.zeros(sizes[1], 3)) is None


def test_silog_in_closed_form():
    d = torch.tensor([0.2, 0.4, 0.8], dtype=torch.float64)
    predicted = torch.tensor([0.4, 0.4, 0.4], dtype=torch.float64)
    g = np.log(predicted.numpy() + 1e-3) - np.log(d.numpy() + 1e-3)
    expected = 10 * (math.sqrt(g.var() + 0.15 * g.mean() ** 2 + 1e-8) - 1e-4)
    assert float(silog(predicted, d)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("value", [0.0, 0.3, 1.0])
def test_silog_at_exact_agreement_has_a_finite_slope(value):
    predicted = torch.full((7,), value, requires_grad=True)
    loss = silog(predicted, torch.full((7,), value))
    loss.backward()
    assert abs(loss.item()) < 1e-6 and torch.isfinite(predicted.grad).all()


def test_one_zero_depth_does_not_drown_the_rest():
    """With the offset 1e-7 of common code this is 14.6."""
    truth = torch.full((100,), 0.5)
    predicted = truth.clone()
    predicted[0] = 0
    assert 4 < float(silog(predicted, truth)) < 7


@pytest.mark.parametrize("known", [0, 1])
def test_depth_of_fewer_than_two_pixels_is_undefined(known):
    mask = torch.zeros(4, 4, dtype=torch.bool)
    mask.view(-1)[:known] = True
    assert depth_loss(torch.rand(4, 4), torch.rand(4, 4), mask) is None


def test_depth_loss_is_the_sum_of_its_three_terms():
    predicted = torch.tensor([[0.5, 0.6], [0.5, 0.0]], dtype=torch.float64)
    truth = torch.tensor([[0.4, 0.4], [0.4, 1.0]], dtype=torch.float64)
    mask = torch.tensor([[True, True], [True, False]])
    expected = float(silog(predicted[mask].float(), truth[mask].float()))
    # Masked square, a mean; one pair of rows with equal errors, one pair of columns 0.1 apart.
    expected += (0.01 + 0.04 + 0.01) / 3 + 0.0 + 0.1
    assert float(depth_loss(predicted, truth, mask)) == pytest.approx(expected, rel=1e-5)


def test_depth_loss_ignores_the_background_and_the_size_of_the_picture():
    rng = torch.Generator().manual_seed(0)
    predicted, truth = torch.rand(6, 6, generator=rng), torch.rand(6, 6, generator=rng)
    mask = torch.ones(6, 6, dtype=torch.bool)
    small = depth_loss(predicted, truth, mask)
    wide = torch.nn.functional.pad
    large = depth_loss(wide(predicted, (9, 9, 9, 9), value=0.7), wide(truth, (9,) * 4),
                       wide(mask, (9,) * 4))  # fmt: skip
    assert float(small) == pytest.approx(float(large), rel=1e-6)


def test_splat_keeps_mass_and_saturates():
    point = torch.tensor([[0.1, -0.2, 0.3]])
    volume = splat(point, 16, strength=1e-4)
    assert float(volume.sum()) == pytest.approx(1e-4, rel=1e-2)
    centre = (volume / volume.sum() * torch.arange(16)[:, None, None]).sum()
    assert float((centre + 0.5) / 8 - 1) == pytest.approx(0.1, abs=1e-2)
    assert float(splat(point.expand(500, 3), 16).max()) <= 1
    assert float(splat(torch.full((3, 3), 4.0), 8).sum()) == 0


def test_splat_pulls_points_towards_their_truth():
    truth = splat(torch.tensor([[0.0, 0.0, 0.0]]), 8)
    points = torch.tensor([[0.12, 0.0, 0.0]], requires_grad=True)
    (1 - (splat(points, 8) * truth).sum()).backward()
    assert points.grad[0, 0] > 0 and torch.isfinite(points.grad).all()


def _tube(radius, n=20):
    x = np.zeros((n, n, n))
    x[:, n // 2, n // 2] = 1
    return torch.tensor(distance_transform_edt(x == 0) <= radius).float()[None, None]


@pytest.mark.parametrize("radius", [1, 2, 3])
def test_soft_skeleton_thins_only_with_enough_iterations(radius):
    tube = _tube(radius)
    enough = soft_skeleton(tube, radius + 1)[0, 0, 6:14]
    assert float(enough[:, 10, 10].min()) == 1 and float(enough.sum()) <= 8 * 5
    if radius == 3:
        assert float(soft_skeleton(tube, 1)[0, 0, 6:14].sum()) < float(enough.sum())


def test_skeleton_dice_edges():
    empty, tube = torch.zeros(12, 12, 12), _tube(1, 12)[0, 0]
    assert float(skeleton_dice_loss(empty, empty)) == pytest.approx(0, abs=1e-6)
    assert float(skeleton_dice_loss(tube, tube)) == pytest.approx(0, abs=0.02)
    alone = float(skeleton_dice_loss(empty, tube))
    assert 0.9 < alone < 1
    grown = empty.clone().requires_grad_()
    skeleton_dice_loss(grown, tube).backward()
    assert torch.isfinite(grown.grad).all()
