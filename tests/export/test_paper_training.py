"""The paper's predictor: pictures, loss and training."""

import dataclasses

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from scipy.spatial import cKDTree

from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.predict.center_map import decode
from gcar_export.scenes.capsules import Capsules
from gcar_export.scenes.render import path_and_depth, path_lengths
from gcar_export.training import paper
from gcar_export.training.checkpoint import read_manifest
from gcar_export.training.loop import learning_rate
from gcar_export.training.losses import depth_loss, depth_weight, silog
from gcar_export.training.networks.unet import UNetConfig, UNetPredictor
from gcar_export.training.paper import (
    CONFIGS,
    PRESETS,
    Batch,
    PaperTraining,
    batch_loss,
    train,
)
from gcar_export.training.paper_dataset import lumen_points, training_pictures
from gcar_export.training.run_folder import read_log
from gcar_export.training.train import start

CONFIG = UNetConfig(pixels=64, alpha=2, width=(4, 4, 8))


@pytest.fixture(scope="module")
def drawn():
    return [p for i in range(3) for p in training_pictures(7, i, CONFIG)]


def _view():
    return CArm(
        primary_angle_deg=35, secondary_angle_deg=-20, sod_mm=750, sdd_mm=1100, rows=64,
        columns=64, pixel_spacing_mm=(2.0, 2.0),
    )  # fmt: skip


def test_depth_of_a_ball_is_the_distance_to_its_middle():
    carm, middle = _view(), np.array([[12.0, -8.0, 20.0]])
    path, depth = path_and_depth(carm, middle, middle + 1e-6, np.array([5.0]))
    seen = path > 1
    rays = carm.rays(np.argwhere(seen)[:, ::-1])
    np.testing.assert_allclose(depth[seen], rays @ (middle[0] - carm.source_mm), atol=1e-4)
    assert np.isnan(depth[path == 0]).all() and seen.sum() > 20


def test_depth_is_that_of_the_longest_stretch_and_overlaps_join():
    carm = _view()
    ray = carm.rays(np.array([[32, 32]]))[0]
    at = [carm.source_mm + t * ray for t in (700.0, 702.0, 760.0)]
    thin, thick = 2.0, 3.0
    starts = np.array(at)
    # Two touching balls make one stretch of 6 mm, as long as the thick one; make it win.
    radii = np.array([thin, thin, thick - 0.1])
    path, depth = path_and_depth(carm, starts, starts + 1e-6, radii)
    assert depth[32, 32] == pytest.approx(701.0, abs=1e-3)
    assert path[32, 32] == pytest.approx(6.0 + 5.8, abs=1e-3)
    alone = path_and_depth(carm, starts[1:], starts[1:] + 1e-6, radii[1:])[1]
    assert alone[32, 32] == pytest.approx(760.0, abs=1e-3)


def test_path_is_the_one_that_every_other_scene_is_made_of():
    rng = np.random.default_rng(1)
    starts = rng.normal(size=(40, 3)) * 20
    ends, radii = starts + rng.normal(size=(40, 3)) * 4, rng.uniform(0.5, 2.5, 40)
    path, _ = path_and_depth(_view(), starts, ends, radii)
    np.testing.assert_allclose(path, path_lengths(_view(), starts, ends, radii), atol=1e-4)


def test_pictures_are_a_function_of_seed_and_index(drawn):
    again = training_pictures(7, 1, CONFIG)
    np.testing.assert_array_equal(again[0].picture.path_mm, drawn[2].picture.path_mm)
    np.testing.assert_array_equal(again[1].depth, drawn[3].depth)


def test_true_depth_lifts_onto_the_vessel(drawn):
    for p in drawn:
        answer = np.concatenate([p.depth[None], np.zeros((3, *p.depth.shape))])
        found = decode(answer, p.picture, CONFIG.alpha)
        known = p.known[tuple(found.cell.T)]
        off = cKDTree(p.centerline_mm).query(found.points_mm[known])[0]
        # A cell is two pixels wide and a vessel at most 3.4 mm in radius.
        assert (off < 3.4 + 2 * p.picture.pixel_mm).mean() > 0.97


def test_training_lifts_as_deployment_does(drawn):
    batch = Batch.of(drawn[:2], CONFIG.alpha, "cpu")
    out = UNetPredictor(CONFIG).eval()(batch.pictures)
    for k, p in enumerate(drawn[:2]):
        made = batch.centers(out, k).detach().numpy() * 64 * p.picture.pixel_mm
        found = decode(out[k].detach().numpy(), p.picture, CONFIG.alpha).points_mm
        np.testing.assert_allclose(made @ p.picture.carm.axes, found, atol=2e-3)


def test_true_depth_has_a_lower_loss_than_a_wrong_one(drawn):
    batch = Batch.of(drawn, CONFIG.alpha, "cpu")
    options = PaperTraining(chamfer_start=10, cldice_voxels=32)
    true = torch.zeros(len(drawn), 4, *batch.depth.shape[1:])
    true[:, 0] = torch.where(batch.known, batch.depth, torch.tensor(0.5))
    wrong = true.clone()
    wrong[:, 0] = 0.5
    assert batch_loss(true, batch, 40, options)[0] < 0.8 * batch_loss(wrong, batch, 40, options)[0]


def test_an_empty_picture_is_left_out_and_counted(drawn):
    batch = Batch.of(drawn[:2], CONFIG.alpha, "cpu")
    batch.cells[0] = False
    batch.known[0] = False
    out = torch.full((2, 4, 32, 32), 0.5, requires_grad=True)
    loss, left_out = batch_loss(out, batch, 40, PaperTraining(chamfer_start=10, cldice_voxels=16))
    loss.backward()
    assert left_out == {"depth": 1, "chamfer": 1}
    assert torch.isfinite(loss) and torch.isfinite(out.grad).all()


def test_points_fill_the_lumen_evenly():
    """A tube of 2 mm and one of 1 mm, as long: four fifths of the points in the wider one."""
    tube = Capsules(
        np.array([[0.0, 0, 0], [0, 0, 50]]), np.array([[40.0, 0, 0], [40, 0, 50]]),
        np.array([2.0, 1.0]),
    )  # fmt: skip
    points = lumen_points(np.random.default_rng(0), tube, 20_000)
    wide = points[:, 2] < 25
    assert wide.mean() == pytest.approx(0.8, abs=0.02)
    axis = np.clip(points[:, 0], 0, 40)
    middle = np.column_stack([axis, np.zeros(len(points)), np.where(wide, 0, 50)])
    off = np.linalg.norm(points - middle, axis=1)
    assert (off[wide] <= 2).all() and (off[~wide] <= 1).all()
    assert np.abs(points[wide, 1]).max() > 1.8


def test_the_set_up_is_the_papers_two_views(drawn):
    for k, p in enumerate(drawn):
        carm = p.picture.carm
        assert (carm.primary_angle_deg, carm.secondary_angle_deg) == (90.0 * (k % 2), 0.0)
        assert carm.pixel_at_isocenter_mm * 64 == pytest.approx(180.0)
        # Whole trees inside the cube, on both pictures.
        assert np.abs(p.centerline_mm).max() < 90


def test_depth_terms_as_printed_are_the_means_times_their_pixels(drawn):
    p = drawn[0]
    depth, known = torch.from_numpy(p.depth), torch.from_numpy(p.known)
    wrong = torch.where(known, depth + 0.01, depth)
    # A constant error has no gradient: SILog alone and the square are left.
    scale = silog(wrong[known], depth[known])
    mean, total = (depth_loss(wrong, depth, known, terms) for terms in ("mean", "sum"))
    assert float(mean - scale) == pytest.approx(1e-4, rel=1e-2)
    assert float(total - scale) == pytest.approx(1e-4 * int(known.sum()), rel=1e-2)
    assert depth_weight("sum") == pytest.approx(0.01)
    with pytest.raises(ValueError, match="none of mean, sum"):
        depth_loss(wrong, depth, known, "median")


def test_output_has_its_shape_and_bounds():
    config = UNetConfig(pixels=48, alpha=3, width=(4, 6, 8))
    out = UNetPredictor(config)(torch.rand(2, 1, 48, 48) * 50)
    assert out.shape == (2, 4, 16, 16)
    assert ((out[:, 0] >= 0) & (out[:, 0] <= 1)).all() and (out[:, 1:].abs() <= 3).all()


@pytest.mark.parametrize("wrong", [{"alpha": 3}, {"pixels": 72, "width": (4,) * 5}])
def test_sizes_that_do_not_divide_are_refused(wrong):
    with pytest.raises(ValueError, match="must be a multiple"):
        UNetConfig(**wrong)


def test_schedule_is_a_function_of_the_step():
    o = PaperTraining(steps=100, decay_steps=20, warmup_steps=10, learning_rate=1.0)
    assert [learning_rate(o, k) for k in (0, 9, 79, 90, 100)] == pytest.approx([0.1, 1, 1, 0.5, 0])


@pytest.mark.slow
def test_training_resumes_to_the_bit(tmp_path):
    options = PRESETS["tiny"]
    train(tmp_path / "whole", options, CONFIGS["tiny"])
    for _ in range(60):
        train(tmp_path / "parts", options, CONFIGS["tiny"], until=0.02)
        if int(load_file(tmp_path / "parts/checkpoint.safetensors")["step"]) == options.steps:
            break
    a, b = (load_file(tmp_path / k / "checkpoint.safetensors") for k in ("whole", "parts"))
    assert a.keys() == b.keys()
    for key in a:
        assert torch.equal(a[key], b[key]), key
    names = {f.name for f in (tmp_path / "whole").iterdir()}
    assert names == {
        "checkpoint.safetensors", "best.safetensors", "manifest.json", "log.csv", "curve.png",
        "run.lock",
    }  # fmt: skip
    best = [read_manifest(tmp_path / k / "best.safetensors")["best"] for k in ("whole", "parts")]
    assert best[0]["step"] == best[1]["step"] in (2, 4)
    log = read_log(tmp_path / "whole/log.csv")
    assert read_log(tmp_path / "parts/log.csv") == log
    assert [r["step"] for r in log] == ["2", "2", "4", "4"], "a row a view"
    errors = {
        step: np.mean([float(r["depth_error"]) for r in log if r["step"] == step])
        for step in ("2", "4")
    }
    assert errors[str(best[0]["step"])] == min(errors.values())


def test_what_is_learned_is_saved_before_it_is_scored(tmp_path, monkeypatch):
    def ends(*_):
        raise MemoryError

    one = dataclasses.replace(PRESETS["tiny"], steps=1, decay_steps=1)
    with monkeypatch.context() as torn, pytest.raises(MemoryError):
        torn.setattr(paper, "validate", ends)
        train(tmp_path, one, CONFIGS["tiny"])
    assert int(load_file(tmp_path / "checkpoint.safetensors")["step"]) == 1
    monkeypatch.setattr(paper, "batch_loss", ends)  # no step is taken
    train(tmp_path, one, CONFIGS["tiny"])
    assert {r["step"] for r in read_log(tmp_path / "log.csv")} == {"1"}


@pytest.mark.slow
def test_a_step_in_bfloat16_stays_near_one_in_float32(tmp_path):
    """The code path of the gpu preset, as far as a CPU goes."""
    one = dataclasses.replace(PRESETS["tiny"], steps=1, decay_steps=1)
    train(tmp_path / "full", dataclasses.replace(one, bf16=False), CONFIGS["tiny"])
    train(tmp_path / "half", one, CONFIGS["tiny"])
    a, b = (load_file(tmp_path / k / "checkpoint.safetensors") for k in ("full", "half"))
    assert any(not torch.equal(a[k], b[k]) for k in a)
    for key in a:
        if key.startswith("net."):
            torch.testing.assert_close(a[key], b[key], atol=2 * one.learning_rate, rtol=0.05)


def test_a_refusal_names_the_network_as_the_option_does(tmp_path):
    with pytest.raises(UsageError, match="network paper starts from random weights"):
        start(tmp_path, "paper", "tune")


def test_gpu_preset_is_longer_and_runs_compiled_in_bfloat16():
    gpu = PRESETS["gpu"]
    assert gpu.device == "cuda" and gpu.bf16 and gpu.compiled
    assert gpu.steps > 10 * PRESETS["cpu"].steps
