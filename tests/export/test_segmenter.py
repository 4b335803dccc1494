"""Generated angiograms, the segmentation network's training, and its way into the runtime."""

import json

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the export extra")

from gcar_deploy.config import ImagingOptions  # noqa: E402
from gcar_deploy.errors import ModelError  # noqa: E402
from gcar_deploy.imaging.extract import extract_vessels  # noqa: E402
from gcar_deploy.imaging.net import INPUT, Segmenter, net_input  # noqa: E402
from gcar_deploy.imaging.segment import learned_centreline  # noqa: E402
from gcar_deploy.predict.model_spec import read_model  # noqa: E402
from gcar_export.angiograms import SIDE, generated_angiogram, training_pair  # noqa: E402
from gcar_export.export_segmenter import _GroupNorm, export_segmenter  # noqa: E402
from gcar_export.networks.mask_unet import MaskUNet  # noqa: E402
from gcar_export.train_segmenter import TINY, learning_rate, train  # noqa: E402
from tests.imaging.phantoms import angiogram, raw_picture, tube_paths  # noqa: E402


def test_pictures_are_functions_of_their_number():
    a, b, c = (generated_angiogram(5, i) for i in (0, 0, 1))
    np.testing.assert_array_equal(a.pixels, b.pixels)
    assert (a.pixels != c.pixels).any()
    assert a.pixels.dtype == np.uint8 and a.pixels.shape == (SIDE, SIDE)


def test_vessels_are_darker_than_what_surrounds_them():
    darker = []
    for i in range(8):
        made = generated_angiogram(6, i)
        near = cv2.dilate(made.mask.astype(np.uint8), np.ones((9, 9))) > 0
        ring = near & ~(cv2.dilate(made.mask.astype(np.uint8), np.ones((5, 5))) > 0)
        darker.append(made.pixels[made.mask].mean() < made.pixels[ring].mean())
        assert 0.003 < made.mask.mean() < 0.4
    assert np.mean(darker) > 0.9


def test_input_and_truth_belong_together():
    """The network's own channels are larger on vessel than off it, flips included."""
    for i in range(4):
        channels, truth = training_pair(7, i, ImagingOptions())
        assert channels.shape == (2, SIDE, SIDE) and channels.dtype == np.float32
        on, off = channels[:, truth > 0].mean(axis=1), channels[:, truth == 0].mean(axis=1)
        assert (on > off).all()


def test_input_does_not_depend_on_gain_or_offset():
    rng = np.random.default_rng(0)
    flat, response = rng.normal(size=(2, 40, 48)).astype(np.float32)
    valid = np.ones((40, 48), bool)
    valid[:4] = False
    one = net_input(flat, np.abs(response), valid)
    other = net_input(7 * flat + 3, 7 * np.abs(response), valid)
    np.testing.assert_allclose(one, other, atol=1e-5)
    assert not one[:, :4].any()


def test_schedule():
    options = TINY.__class__(steps=100, decay_steps=50, warmup_steps=10)
    rates = [learning_rate(options, k) for k in range(101)]
    assert rates[0] < rates[9] == rates[49] == options.learning_rate
    assert rates[75] == pytest.approx(options.learning_rate / 2) and rates[100] == 0


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    out = tmp_path_factory.mktemp("segmenter")
    train(out / "run", TINY)
    worst = export_segmenter(out / "run" / "checkpoint.safetensors", out / "tiny.onnx", 2)
    assert worst < 1e-4
    return out


@pytest.mark.slow
def test_training_goes_on_where_it_stopped(trained, tmp_path):
    from safetensors.torch import load_file

    options = TINY
    train(tmp_path, options.__class__(**{**options.__dict__, "steps": 2, "decay_steps": 1}))
    assert json.loads((tmp_path / "manifest.json").read_text())["step"] == 2
    train(tmp_path, options)
    done = load_file(tmp_path / "checkpoint.safetensors")
    assert int(done["step"]) == 3
    assert json.loads((tmp_path / "manifest.json").read_text())["validation_dice"] >= 0


@pytest.mark.slow
def test_the_runtime_reads_and_runs_it(trained):
    model = read_model(trained / "tiny.onnx", wanted=INPUT)
    segmenter = Segmenter(model.data, model.name, threads=1)
    rng = np.random.default_rng(1)
    found = segmenter.probability(rng.normal(size=(2, 61, 83)).astype(np.float32))
    assert found.shape == (61, 83) and (found >= 0).all() and (found <= 1).all()
    with pytest.raises(ModelError, match=r"wants inputs\.channels"):
        read_model(trained / "tiny.onnx", wanted={**INPUT, "channels": 3})
    with pytest.raises(ModelError, match="segmenter"):
        read_model(trained / "tiny.onnx")


@pytest.mark.slow
def test_who_is_asked(trained):
    segmenter = Segmenter((trained / "tiny.onnx").read_bytes(), "tiny", threads=1)
    picture = angiogram(raw_picture(tube_paths()))
    with pytest.raises(ModelError, match="not loaded"):
        extract_vessels(picture, ImagingOptions(segmenter="net"))
    # auto: the classical method finds the tubes, so the network is never asked
    found = extract_vessels(picture, ImagingOptions(segmenter="auto"), segmenter)
    assert found.mask.any()


def test_lines_from_a_certain_probability():
    """A drawn line with a gap below the lower threshold, and a faint stroke of its own."""
    sure = np.zeros((120, 120), np.float32)
    cv2.line(sure, (10, 60), (110, 60), 0.95, 5)
    cv2.line(sure, (10, 20), (110, 20), 0.5, 5)  # never above the upper threshold
    line = learned_centreline(sure, np.ones((120, 120), bool), 0.5, ImagingOptions())
    rows, _ = np.nonzero(line)
    assert rows.size > 80 and set(rows) <= {59, 60, 61}
    nothing = learned_centreline(0 * sure, np.ones((120, 120), bool), 0.5, ImagingOptions())
    assert not nothing.any()


def test_size_of_the_network():
    assert 150_000 < sum(p.numel() for p in MaskUNet().parameters()) < 500_000


def test_the_exported_norm_is_the_trained_one():
    norm = torch.nn.GroupNorm(5, 20)
    with torch.no_grad():
        norm.weight.uniform_(0.5, 2.0)
        norm.bias.uniform_(-1.0, 1.0)
    x = 3.0 + torch.randn(1, 20, 24, 40) * torch.linspace(0.01, 5.0, 20)[None, :, None, None]
    torch.testing.assert_close(_GroupNorm(norm)(x), norm(x), rtol=1e-4, atol=1e-5)
