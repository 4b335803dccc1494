"""Scenes, losses, training that resumes to the bit, and the way from checkpoint to ONNX."""

import dataclasses
import functools
import json
import os
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from gcar_deploy.errors import GcarError, ModelError, UsageError
from gcar_deploy.models.card import model_card
from gcar_deploy.models.session import Session
from gcar_deploy.models.spec import read_model, shipped_model_path
from gcar_deploy.predict.encoding import flat_inputs, input_names
from gcar_deploy.predict.kinds import MULTI
from gcar_export.shipping.export_onnx import DeployedSparse, _spec
from gcar_export.shipping.tiny_model import TINY
from gcar_export.training import multi
from gcar_export.training.dataset import training_scene
from gcar_export.training.examinations import SceneOptions
from gcar_export.training.loop import learning_rate
from gcar_export.training.multi import (
    CONFIGS,
    PRESETS,
    TrainOptions,
    inputs,
    scene_loss,
    train,
)
from gcar_export.training.networks.sparse import SparsePredictor
from gcar_export.training.run_folder import load_weights, read_log
from gcar_export.training.scene_stream import in_order
from gcar_export.training.warm_start import OWN_LICENSE, license_of


@pytest.fixture(autouse=True, scope="module")
def usual_threads():
    """Blurs differ in the last bit by the number of threads, which other tests set."""
    cv2.setNumThreads(-1)


@pytest.fixture(scope="module")
def scenes():
    return [training_scene(7, i) for i in range(3)]


def test_scene_is_a_function_of_seed_and_index(scenes):
    again = training_scene(7, 1)
    np.testing.assert_array_equal(again.encoded.features, scenes[1].encoded.features)
    np.testing.assert_array_equal(again.occupancy, scenes[1].occupancy)
    assert len(training_scene(8, 1).occupancy) != len(again.occupancy)


def test_truth_lies_on_the_hull(scenes):
    for s in scenes:
        n = s.encoded.features.shape[1]
        assert s.occupancy.shape == (n,) and s.offset_cells.shape == (n, 3)
        assert 0.01 < (s.occupancy >= 0.5).mean() < 0.5
        inside = s.occupancy > 0.9
        # From a full cell some centreline is about as near as its radius.
        distance = np.linalg.norm(s.offset_cells[inside], axis=1)
        assert (distance <= s.radius_cells[inside] + 0.5).mean() > 0.98


def test_views_of_the_truth_explain_the_pictures():
    exact = training_scene(11, 0, SceneOptions(inputs=(1.0, 0.0, 0.0, 0.0), thin_share=0.0))
    e = exact.encoded
    made = np.bincount(e.ray[0], exact.occupancy * e.weight[0], minlength=e.ray_path.shape[1])
    assert made.sum() == pytest.approx(e.ray_path[0].sum(), rel=0.35)


def test_gather_matmul_backward_equals_autograd(scenes):
    torch.manual_seed(0)
    net = SparsePredictor(TINY).double()
    for p in net.parameters():
        if p.abs().max() == 0:
            torch.nn.init.normal_(p, std=0.1)
    f, ray, path, weight, nb, parent = inputs(scenes[0])
    grads = []
    for training in (True, False):
        net.train(training)
        net.zero_grad()
        out = net(f.double(), ray, path.double(), weight.double(), nb, parent)
        sum(o.square().mean() for o in out).backward()
        grads.append([p.grad.clone() for p in net.parameters() if p.grad is not None])
    for a, b in zip(*grads, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11)


def test_loss_falls_to_nearly_nothing_on_the_truth(scenes):
    scene = scenes[0]
    truth = torch.from_numpy(np.clip(scene.occupancy, 1e-4, 1 - 1e-4))
    perfect = torch.cat(
        [
            torch.logit(truth)[:, None],
            torch.from_numpy(scene.offset_cells),
            torch.from_numpy(scene.radius_cells)[:, None],
        ],
        dim=1,
    )
    wrong = torch.zeros_like(perfect)
    assert scene_loss([perfect], scene) < 0.35 * scene_loss([wrong], scene)


def test_empty_truth_is_no_nan(scenes):
    nothing = dataclasses.replace(scenes[0], occupancy=np.zeros_like(scenes[0].occupancy))
    out = torch.zeros(len(nothing.occupancy), 5, requires_grad=True)
    loss = scene_loss([out], nothing)
    loss.backward()
    assert torch.isfinite(loss) and torch.isfinite(out.grad).all()


def test_schedule_is_a_function_of_the_step():
    o = TrainOptions(steps=100, decay_steps=20, warmup_steps=10, learning_rate=1.0)
    rates = [learning_rate(o, k) for k in (0, 9, 50, 79, 80, 90, 100)]
    assert rates == pytest.approx([0.1, 1, 1, 1, 1, 0.5, 0])


@pytest.mark.slow
@pytest.mark.req("REQ-48")
def test_training_resumes_to_the_bit(tmp_path):
    options = PRESETS["tiny"]
    train(tmp_path / "whole", options, CONFIGS["tiny"])
    train(tmp_path / "parts", options, CONFIGS["tiny"], until=0.0)
    half = dataclasses.replace(options, save_every=1)
    train(tmp_path / "parts", half, CONFIGS["tiny"], until=1e-9)
    for _ in range(40):
        train(tmp_path / "parts", half, CONFIGS["tiny"], until=0.05)
        if int(load_file(tmp_path / "parts/checkpoint.safetensors")["step"]) == options.steps:
            break
    a, b = (load_file(tmp_path / k / "checkpoint.safetensors") for k in ("whole", "parts"))
    assert a.keys() == b.keys()
    for key in a:
        assert torch.equal(a[key], b[key]), key
    logs = [read_log(tmp_path / k / "log.csv") for k in ("whole", "parts")]
    assert [r for r in logs[1] if int(r["step"]) % options.save_every == 0] == logs[0]


def test_what_is_learned_is_saved_before_it_is_scored(tmp_path, monkeypatch):
    def ends(*_):
        raise MemoryError

    one = dataclasses.replace(PRESETS["tiny"], steps=1, decay_steps=1, validation_scenes=1)
    with monkeypatch.context() as torn, pytest.raises(MemoryError):
        torn.setattr(multi, "validate", ends)
        train(tmp_path, one, TINY)
    assert int(load_file(tmp_path / "checkpoint.safetensors")["step"]) == 1
    monkeypatch.setattr(multi, "scene_loss", ends)  # no step is taken
    train(tmp_path, one, TINY)
    assert [r["step"] for r in read_log(tmp_path / "log.csv")] == ["1"]


def _children(pid):
    return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
def test_replicas_end_with_their_parent(tmp_path):
    code = (
        "import dataclasses, pathlib, sys\nfrom gcar_export.training.multi import *\n"
        "if __name__ == '__main__':\n"
        "    o = dataclasses.replace(PRESETS['tiny'], steps=100000, replicas=2)\n"
        "    train(pathlib.Path(sys.argv[1]), o, CONFIGS['tiny'])\n"
    )
    program = tmp_path / "train.py"
    program.write_text(code)
    with subprocess.Popen([sys.executable, str(program), str(tmp_path / "run")]) as parent:
        until = time.monotonic() + 240
        while not (tmp_path / "run/checkpoint.safetensors").exists():
            assert time.monotonic() < until and parent.poll() is None
            time.sleep(0.5)
        replicas = _children(parent.pid)
        parent.kill()
    assert len(replicas) >= 2
    until = time.monotonic() + 60
    while any(Path(f"/proc/{pid}/cmdline").exists() and _alive(pid) for pid in replicas):
        assert time.monotonic() < until
        time.sleep(0.2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("replicas", "number"), [(1, signal.SIGINT), (2, signal.SIGINT), (2, signal.SIGTERM)]
)
def test_an_interrupt_of_all_processes_saves_the_run(tmp_path, replicas, number):
    """Ctrl-C in a terminal, and what a scheduler sends, reach the replicas as well."""
    code = (
        "import dataclasses, pathlib, sys\nfrom gcar_export.training.multi import *\n"
        "if __name__ == '__main__':\n"
        f"    o = dataclasses.replace(PRESETS['tiny'], steps=100000, replicas={replicas})\n"
        "    o = dataclasses.replace(o, validation_scenes=1, save_every=10**6)\n"
        "    train(pathlib.Path(sys.argv[1]), o, CONFIGS['tiny'])\n"
    )
    program = tmp_path / "train.py"
    program.write_text(code)
    with subprocess.Popen(
        [sys.executable, str(program), str(tmp_path / "run")], start_new_session=True,
        stderr=subprocess.PIPE, text=True,
    ) as parent:  # fmt: skip
        for text in parent.stderr:
            if text.startswith("step "):
                os.killpg(parent.pid, number)
                break
        said = parent.stderr.read()
        assert parent.wait(60) != 0
    step = int(load_file(tmp_path / "run/checkpoint.safetensors")["step"])
    assert step >= 25 and f"is saved at step {step}; the same command goes on" in said
    assert "Process" not in said


def _alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.slow
def test_a_step_in_bfloat16_stays_near_one_in_float32(tmp_path):
    """The code path of the gpu preset, as far as a CPU goes."""
    one = dataclasses.replace(PRESETS["tiny"], steps=1, decay_steps=1, validation_scenes=1)
    train(tmp_path / "full", one, CONFIGS["tiny"])
    train(tmp_path / "half", dataclasses.replace(one, bf16=True), CONFIGS["tiny"])
    a, b = (load_file(tmp_path / k / "checkpoint.safetensors") for k in ("full", "half"))
    assert any(not torch.equal(a[k], b[k]) for k in a)
    for key in a:
        if key.startswith("net."):
            torch.testing.assert_close(a[key], b[key], atol=2 * one.learning_rate, rtol=0.05)


@pytest.mark.slow
def test_a_training_may_begin_from_a_model(tmp_path):
    shipped = shipped_model_path("gcp-multi")
    train(tmp_path, PRESETS["tiny"], CONFIGS["cpu"], until=0.0, warm_start=shipped)
    net, scene = DeployedSparse(SparsePredictor(CONFIGS["cpu"])), training_scene(7, 0).encoded
    load_weights(net.net, load_file(tmp_path / "checkpoint.safetensors"))
    arrays = flat_inputs(scene)
    with torch.no_grad():
        ours = net.eval()(*[torch.from_numpy(x) for x in arrays]).numpy()
    model = Session(read_model(shipped, (MULTI,)), input_names(), threads=1)
    theirs = model.answers(dict(zip(input_names(), arrays, strict=True)))["centers"]
    np.testing.assert_allclose(ours, theirs, atol=1e-4)
    with pytest.raises(UsageError, match="warm_start"):
        train(tmp_path, PRESETS["tiny"], CONFIGS["cpu"], until=0.0)


def _generation(folder, parent, monkeypatch, labels=None):
    """Card of a model that was trained on from another one."""
    file = types.SimpleNamespace(spec=parent, name="m", sha256="0" * 64, kind="multi")
    monkeypatch.setattr(multi, "predictor_of", lambda _: (SparsePredictor(TINY), file))
    train(folder, PRESETS["tiny"], TINY, until=0.0, warm_start=folder, labels=[None] * bool(labels),
          label_hashes=labels)  # fmt: skip
    manifest = json.loads((folder / "manifest.json").read_text())
    return _spec(DeployedSparse(SparsePredictor(TINY)), manifest, "m")


def test_what_the_first_weights_were_trained_on_stays_said(tmp_path, monkeypatch):
    monkeypatch.setattr(multi, "training_scene", lambda *a, **k: None)  # no step is taken
    parent = {"training": {"labels": {"a": "1" * 64}}}
    parent["license"] = license_of(parent["training"])
    assert parent["license"] == "that of the label volumes named in training.labels"
    child = _generation(tmp_path / "one", parent, monkeypatch)
    assert child["license"] == "that of the label volumes named in training.labels_before"
    assert child["training"]["labels_before"] == {"a": "1" * 64}
    assert child["training"]["data"].startswith("generated trees and label volumes")
    file = types.SimpleNamespace(
        spec=child, name="m", sha256="0", kind="multi", data=b"", inputs={}
    )
    assert "label volume a 111111111111, of its first weights" in "\n".join(model_card(file))
    # terms that somebody wrote into a card go on as they are
    child["license"] = "CC-BY-NC-4.0"
    second = _generation(tmp_path / "two", child, monkeypatch, {"a": "2" * 64})
    both = "that of the label volumes named in training.labels and training.labels_before"
    assert second["license"] == f"{both}; CC-BY-NC-4.0"
    third = _generation(tmp_path / "three", second, monkeypatch)
    assert third["license"] == (
        "that of the label volumes named in training.labels_before; CC-BY-NC-4.0"
    )
    kept = third["training"]["labels_before"]
    assert kept == {"a": "2" * 64, "a (11111111)": "1" * 64}
    plain = _generation(tmp_path / "plain", {"license": OWN_LICENSE}, monkeypatch)
    assert plain["license"] == OWN_LICENSE


def test_a_replicas_own_reason_is_told(tmp_path, monkeypatch):
    traceback = "\n\n-- Process 1 terminated with the following error:\nTraceback:\n  File ...\n"

    def ends(*_, **__):
        raise torch.multiprocessing.ProcessRaisedException(traceback + last + "\n", 1, 123)

    monkeypatch.setattr(torch.multiprocessing, "spawn", ends)
    two = dataclasses.replace(PRESETS["tiny"], replicas=2)
    last = "gcar_deploy.errors.ModelError: checkpoint c: cannot be read"
    with pytest.raises(ModelError, match=r"^checkpoint c: cannot be read$"):
        train(tmp_path, two, TINY)
    last = "RuntimeError: no memory"
    with pytest.raises(GcarError, match=r"^a replica ended: RuntimeError no memory$"):
        train(tmp_path, two, TINY)


def test_a_warm_start_of_another_size_is_refused(tmp_path):
    with pytest.raises(ModelError, match=r"gcp-multi.onnx holds .* not"):
        train(
            tmp_path, PRESETS["tiny"], TINY, until=0.0, warm_start=shipped_model_path("gcp-multi")
        )


@pytest.mark.slow
def test_scenes_drawn_ahead_are_those_drawn_here():
    draw = functools.partial(training_scene, 7)
    with in_order(draw, range(1, 4), 0) as here, in_order(draw, range(1, 4), 1) as ahead:
        pairs = list(zip(here, ahead, strict=True))
    assert len(pairs) == 3
    for a, b in pairs:
        np.testing.assert_array_equal(a.encoded.features, b.encoded.features)
        np.testing.assert_array_equal(a.occupancy, b.occupancy)
