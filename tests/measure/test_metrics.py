"""Measures on closed-form pairs, and the table of empty, one-empty and equal inputs."""

import json
import math

import numpy as np
import pytest

from gcar_deploy.measure import metrics
from gcar_deploy.measure.metrics import Measure


def block(low, high, shape=(24, 24, 24)):
    out = np.zeros(shape, bool)
    out[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = True
    return out


def line(x, y, z0=4, z1=20):
    return block((x, y, z0), (x + 1, y + 1, z1))


EMPTY = np.zeros((24, 24, 24), bool)
TUBE = line(12, 12)


def test_dice_of_half_overlapping_blocks():
    found = metrics.dice(block((4, 4, 4), (8, 8, 8)), block((6, 4, 4), (10, 8, 8)))
    assert found == Measure(0.5)


def test_dice_of_disjoint_masks_is_a_true_zero():
    assert metrics.dice(line(3, 3), line(9, 9)).value == 0.0


def test_volume_threshold_is_inclusive():
    truth = np.full((8, 8, 8), 0.5, np.float32)
    assert metrics.volume_dice(truth, truth).value == 1.0
    assert metrics.volume_dice(truth, truth * 0.99).value is None


def test_best_dice_finds_the_threshold():
    truth = block((4, 4, 4), (8, 8, 8)).astype(float)
    predicted = 0.35 * truth + 0.2 * block((4, 4, 4), (12, 8, 8))
    best, threshold = metrics.best_dice(truth, predicted)
    assert best.value == 1.0
    assert threshold == 0.3
    assert metrics.volume_dice(truth, predicted).value == 1.0
    lower, at = metrics.best_dice(truth, predicted * 0.5)
    assert (lower.value, at) == (1.0, 0.2)


@pytest.mark.parametrize("spacing", [(1, 1, 1), (2, 2, 2), (0.5, 1, 3)])
def test_parallel_lines_know_their_distance(spacing):
    a = metrics.skeleton(line(8, 12), spacing)
    b = metrics.skeleton(line(11, 12), spacing)
    gap = 3 * spacing[0]
    assert metrics.chamfer_mm(a, b).value == pytest.approx(gap, abs=1e-12)
    assert metrics.overlap_within(a, b, gap).value == 1.0
    assert metrics.overlap_within(a, b, gap - 0.01).value == 0.0


def test_overlap_counts_both_sides():
    long, short = line(12, 12, 4, 20), line(12, 12, 4, 12)
    a, b = (metrics.skeleton(m, (1, 1, 1)) for m in (long, short))
    n_long, n_short = len(a.index), len(b.index)
    assert (n_long, n_short) == (16, 8)
    assert metrics.overlap_within(a, b, 1.0).value == pytest.approx((9 + 8) / 24)
    assert metrics.chamfer_mm(a, b).value == pytest.approx(0.5 * sum(range(1, 9)) / 16)


def test_skeleton_of_a_thick_tube_is_its_axis():
    x, y = np.mgrid[0:24, 0:24]
    tube = np.repeat(((x - 12) ** 2 + (y - 12) ** 2 <= 9)[:, :, None], 24, axis=2)
    thin = metrics.skeleton(tube, (1, 1, 1))
    assert np.abs(thin.index[:, :2] - 12).max() <= 1


def test_skeleton_does_not_depend_on_the_surrounding():
    small = metrics.skeleton(TUBE, (1, 1, 1)).index
    big = np.zeros((40, 40, 40), bool)
    big[8:32, 8:32, 8:32] = TUBE
    assert np.array_equal(metrics.skeleton(big, (1, 1, 1)).index, small + 8)


def test_cl_dice_of_nested_tubes():
    thick = block((10, 10, 4), (15, 15, 20))
    assert metrics.cl_dice(thick, TUBE).value == 1.0
    half = line(12, 12, 4, 12)
    # precision 1, sensitivity 8/16
    assert metrics.cl_dice(TUBE, half).value == pytest.approx(2 * 0.5 / 1.5)
    assert metrics.cl_dice(TUBE, line(3, 3)).value == 0.0


def test_psnr_masked_and_unmasked():
    truth = np.zeros((10, 10))
    truth[:5] = 2.0
    predicted = truth.copy()
    predicted[0] += 0.2
    assert metrics.psnr_db(truth, predicted).value == pytest.approx(10 * math.log10(4 / 0.004))
    masked = metrics.psnr_db(truth, predicted, masked=True)
    assert masked.value == pytest.approx(10 * math.log10(4 / 0.008))


def test_projection_dice_is_at_half_a_millimetre():
    truth = np.array([[0.0, 0.5, 0.49, 2.0]])
    assert metrics.projection_dice(truth, np.array([[0.0, 3.0, 0.0, 0.5]])).value == 1.0
    assert metrics.projection_dice(truth, np.array([[0.5, 3.0, 0.0, 0.5]])).value == 0.8


def test_ssim_is_one_for_equal_and_less_otherwise():
    rng = np.random.default_rng(0)
    volume = rng.random((9, 9, 9)).astype(np.float32)
    assert metrics.ssim(volume, volume).value == pytest.approx(1.0)
    assert metrics.ssim(volume, volume[::-1]).value < 0.5
    assert metrics.ssim(volume[:6], volume[:6]).value is None


def test_shifted_dice_undoes_a_whole_voxel_shift():
    truth = block((6, 6, 6), (10, 12, 9)).astype(float)
    moved = np.roll(truth, (3, -2, 1), (0, 1, 2))
    assert metrics.volume_dice(truth, moved).value < 0.5
    assert metrics.best_shifted_dice(truth, moved).value == 1.0
    assert metrics.best_shifted_dice(truth, np.roll(truth, 5, 0)).value < 1.0


def test_shifted_dice_does_not_wrap_round():
    truth = block((0, 0, 0), (2, 24, 24)).astype(float)
    far = block((22, 0, 0), (24, 24, 24)).astype(float)
    assert metrics.best_shifted_dice(truth, far).value == 0.0


T, P, BOTH, NONE = (
    "truth is empty",
    "prediction is empty",
    "truth and prediction are empty",
    "no prediction",
)
TABLE = [
    # measure, truth, prediction, reason
    *[("dice", a, b, r) for a, b, r in [(EMPTY, EMPTY, BOTH), (EMPTY, TUBE, T), (TUBE, EMPTY, P)]],
    ("dice", TUBE, None, NONE),
    *[("cl", a, b, r) for a, b, r in [(EMPTY, EMPTY, BOTH), (EMPTY, TUBE, T), (TUBE, EMPTY, P)]],
    ("cl", TUBE, None, NONE),
    *[("ot", a, b, r) for a, b, r in [(EMPTY, EMPTY, T), (EMPTY, TUBE, T), (TUBE, EMPTY, P)]],
    ("ot", TUBE, None, NONE),
    *[("chamfer", a, b, r) for a, b, r in [(EMPTY, EMPTY, T), (EMPTY, TUBE, T), (TUBE, EMPTY, P)]],
    ("chamfer", TUBE, None, NONE),
    *[("shifted", a, b, r) for a, b, r in [(EMPTY, EMPTY, BOTH), (EMPTY, TUBE, T)]],
    ("shifted", TUBE, EMPTY, P),
    ("psnr", EMPTY, TUBE, T),
    ("psnr", EMPTY, EMPTY, T),
    ("psnr", TUBE, TUBE, "identical"),
    ("psnr", TUBE, None, NONE),
    ("masked", TUBE, TUBE, "identical"),
    ("masked", EMPTY, TUBE, T),
    ("ssim", TUBE, None, NONE),
]
CALLS = {
    "dice": metrics.volume_dice,
    "cl": lambda a, b: metrics.cl_dice(a > 0, None if b is None else b > 0),
    "ot": lambda a, b: metrics.overlap_within(*_skeletons(a, b), 1.0),
    "chamfer": lambda a, b: metrics.chamfer_mm(*_skeletons(a, b)),
    "shifted": metrics.best_shifted_dice,
    "psnr": metrics.psnr_db,
    "masked": lambda a, b: metrics.psnr_db(a, b, masked=True),
    "ssim": metrics.ssim,
}


def _skeletons(a, b):
    thin = metrics.skeleton(a > 0, (1, 1, 1))
    return thin, None if b is None else metrics.skeleton(b > 0, (1, 1, 1))


@pytest.mark.parametrize(("name", "truth", "predicted", "reason"), TABLE)
@pytest.mark.req("REQ-42")
def test_undefined_is_none_with_a_reason(name, truth, predicted, reason):
    b = None if predicted is None else predicted.astype(float)
    assert CALLS[name](truth.astype(float), b) == Measure(None, reason)


@pytest.mark.parametrize("truth", [EMPTY, TUBE])
@pytest.mark.parametrize("predicted", [EMPTY, TUBE, None, np.full(TUBE.shape, np.nan)])
def test_every_table_is_strict_json(truth, predicted):
    found = metrics.volume_measures(
        truth.astype(float), None if predicted is None else predicted.astype(float), (1, 1, 1)
    )
    flat = {k: [m.value, m.reason] for k, m in found.items()}
    again = json.loads(json.dumps(flat, allow_nan=False))
    assert set(again) == set(flat)
    assert all((value is None) == (reason is not None) for value, reason in again.values())


def test_equal_volumes_are_perfect():
    found = metrics.volume_measures(TUBE.astype(float), TUBE.astype(float), (1, 1, 1))
    ones = ("dsc", "best_dsc", "ot_1mm", "ot_2mm", "cldice", "ssim")
    assert [found[k].value for k in ones] == pytest.approx([1.0] * 6)
    assert found["chamfer_mm"].value == 0.0


def test_different_grids_are_a_wrong_call():
    with pytest.raises(ValueError, match="not one grid"):
        metrics.volume_dice(TUBE.astype(float), TUBE[:4].astype(float))
