"""Pictures with devices, the network that learns to tell them, and its way into the model."""

import dataclasses
import hashlib
import json

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the export extra")

from gcar_deploy.errors import ModelError, UsageError  # noqa: E402
from gcar_deploy.imaging.net import KIND, SIDE, load_segmenter, open_segmenter  # noqa: E402
from gcar_export.scenes.cine import cine_pair  # noqa: E402
from gcar_export.scenes.device_pictures import (  # noqa: E402
    VESSEL,
    DevicePicture,
    cropped,
    device_picture,
    generator,
    pooled_device_picture,
    turned,
)
from gcar_export.scenes.drawn_devices import drawn_devices  # noqa: E402
from gcar_export.scenes.expert_pictures import expert_pictures  # noqa: E402
from gcar_export.shipping.export_segmenter import (  # noqa: E402
    export_segmenter,
    load_device_checkpoint,
)
from gcar_export.training.devices import (  # noqa: E402
    TINY,
    asked_at_half,
    chosen,
    device_loss,
    train,
)
from gcar_export.training.networks.device_unet import DeviceUNet  # noqa: E402
from gcar_export.training.segmenter_start import devices_of, frozen_segmenter  # noqa: E402


@pytest.fixture(scope="module")
def segmenter():
    return load_segmenter("net", 1)


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """Two pictures of one thick vessel each."""
    folder = tmp_path_factory.mktemp("real")
    for k in (1, 2):
        mask = np.zeros((200, 200), np.uint8)
        cv2.line(mask, (20, 40 * k), (170, 150), 255, 9)
        cv2.imwrite(str(folder / f"{k}_gt.png"), mask)
        cv2.imwrite(str(folder / f"{k}.png"), np.where(mask > 0, 60, 180).astype(np.uint8))
    return expert_pictures(folder)


def test_devices_are_of_every_calibre_and_come_from_outside():
    widths, at_border = [], 0
    for k in range(30):
        drawn = drawn_devices(np.random.default_rng(k), 256)
        assert drawn.shape == (256, 256) and drawn.min() >= 0 and 0.02 < drawn.max() < 2.5
        inside = drawn > 0.5 * drawn.max()
        widths.append(
            2 * float(cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 5).max())
        )
        rim = np.ones_like(inside)
        rim[2:-2, 2:-2] = False
        at_border += bool((drawn[rim] > 0.02).any())
    assert min(widths) < 3 and max(widths) > 5 and at_border >= 20


def test_a_runs_devices_are_seen_in_its_pictures_and_are_no_vessel():
    darker = []
    for number in range(4):
        for run in cine_pair(7_777, number, 3).runs:
            assert run.device.shape == run.pixels.shape and run.device.dtype == bool
            assert not (run.device & (run.path_mm > 1.0)).any()
            near = cv2.dilate(run.device[1].astype(np.uint8), np.ones((11, 11))) > 0
            ring = near & ~run.device[1] & (run.path_mm[1] == 0)
            if run.device[1].sum() > 300:
                darker.append(run.pixels[1][run.device[1]].mean() < run.pixels[1][ring].mean())
    assert len(darker) >= 3 and np.mean(darker) > 0.8


@pytest.mark.slow
def test_what_is_asked_of_each_kind_of_picture(segmenter, real):
    for index in range(6):
        made = device_picture(3, index, segmenter, real)
        again = device_picture(3, index, segmenter, real)
        np.testing.assert_array_equal(made.channels, again.channels)
        assert made.channels.shape == (6, SIDE, SIDE) and np.isfinite(made.channels).all()
        weight = made.weight.astype(np.float32)
        assert weight.max() <= VESSEL and not (made.device & (weight == VESSEL)).any()
        if index % 3 == 2:  # of a real picture's ground nobody says anything
            ground = ~made.device & (weight < 1)
            assert not weight[ground & (cv2.dilate(weight, np.ones((5, 5))) < 0.1)].any()
            assert (weight == VESSEL).any()


def test_a_pooled_picture_is_drawn_once(segmenter, tmp_path):
    stream = generator("0", ())
    one, again = (pooled_device_picture(tmp_path, stream, 4, 1, segmenter, ()) for _ in range(2))
    np.testing.assert_array_equal(one.channels, again.channels)
    assert len(list(tmp_path.iterdir())) == 1


def test_turning_keeps_picture_and_truth_together():
    ramp = np.arange(16.0).reshape(1, 4, 4).astype(np.float16)
    given = DevicePicture(ramp, ramp[0] > 7, ramp[0])
    for k in range(12):
        found = turned(np.random.default_rng(k), given)
        np.testing.assert_array_equal(found.channels[0] > 7, found.device)
        np.testing.assert_array_equal(found.channels[0], found.weight)
        np.testing.assert_array_equal(np.sort(found.weight.ravel()), ramp.ravel())


def test_a_crop_keeps_picture_and_truth_together():
    ramp = np.arange(64.0).reshape(1, 8, 8)
    found = cropped(np.random.default_rng(0), DevicePicture(ramp, ramp[0] > 30, ramp[0]), 4)
    assert found.device.shape == (4, 4)
    np.testing.assert_array_equal(found.channels[0] > 30, found.device)
    np.testing.assert_array_equal(found.channels[0], found.weight)


def test_thin_lines_stay_lines_and_shared_pixels_are_not_asked():
    device, weight = torch.zeros(1, 8, 8), torch.full((1, 8, 8), 0.2)
    device[0, 3] = 1
    weight[0, 3] = 1
    weight[0, 2:4, :2] = torch.tensor([[VESSEL, VESSEL], [1.0, 1.0]])
    truth, asked = asked_at_half(device, weight)
    assert truth.shape == (1, 4, 4) and truth[0, 1].all() and not truth[0, 0].any()
    assert asked[0, 1, 0] == 0 and asked[0, 1, 1] == 1 and asked[0, 0, 0] == pytest.approx(0.2)


def test_loss_is_least_at_the_truth():
    truth = (torch.rand(2, 20, 20) > 0.8).float()
    weight = torch.ones(2, 20, 20)
    right = 30 * (truth - 0.5)
    assert device_loss(right, truth, weight) < 0.05 < 1 < device_loss(-right, truth, weight)
    weight[:, :10] = 0
    other = torch.where(weight > 0, right, -right)
    torch.testing.assert_close(device_loss(other, truth, weight), device_loss(right, truth, weight))


def test_options():
    assert chosen({"fold": "1/2", "steps": 8}).fold == (1, 2)
    assert chosen({"steps": 8}).decay_steps == 8 and chosen({"steps": 8}).warmup_steps == 2
    with pytest.raises(UsageError, match="must be K/N"):
        chosen({"fold": "first"})


@pytest.mark.slow
def test_from_training_to_the_model(segmenter, tmp_path):
    """It goes on where it stopped; in the model the vessels stay to the bit."""
    short = dataclasses.replace(TINY, steps=2)
    train(tmp_path / "run", short, pool=tmp_path / "pool")
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["step"] == 2
    train(tmp_path / "run", TINY, pool=tmp_path / "pool")
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert manifest["step"] == 3 and 0 <= manifest["validation"]["found"] <= 1
    out = tmp_path / "segmenter.onnx"
    checkpoint = tmp_path / "run" / "checkpoint.safetensors"
    assert export_segmenter(KIND.path, out, 2, checkpoint) < 1e-4
    spec = json.loads(out.with_suffix(".json").read_text())
    assert spec["training"]["devices"]["step"] == 3
    channels = device_picture(3, 1, segmenter).channels[:3].astype(np.float32)
    before, after = segmenter.look(channels), open_segmenter(out, threads=1).look(channels)
    np.testing.assert_array_equal(before.probability, after.probability)
    np.testing.assert_array_equal(before.chord, after.chord)
    # The next training stands on the same answers, the segmenter's own word on devices included.
    first, second = (frozen_segmenter(path).look(channels) for path in (KIND.path, out))
    np.testing.assert_array_equal(first.device, second.device)
    np.testing.assert_allclose(first.probability, before.probability, atol=1e-4)
    assert (before.device != after.device).any()
    # Both networks of a model go into another one.
    again = tmp_path / "again.onnx"
    export_segmenter(out, again, 1, out)
    same = open_segmenter(again, threads=1).look(channels)
    np.testing.assert_allclose(same.device, after.device, atol=1e-5)
    assert json.loads(again.with_suffix(".json").read_text())["training"] == spec["training"]


def test_a_training_goes_on_from_a_model(tmp_path):
    options = dataclasses.replace(TINY, steps=1, learning_rate=1e-9)
    train(tmp_path / "run", options, pool=tmp_path / "pool", begin_from=KIND.path)
    own = load_device_checkpoint(tmp_path / "run" / "checkpoint.safetensors").state_dict()
    shipped = load_device_checkpoint(KIND.path).state_dict()
    assert own.keys() == shipped.keys()
    for name, value in own.items():
        assert torch.allclose(value, shipped[name], atol=1e-7), name
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert manifest["warm_start"] == hashlib.sha256(KIND.path.read_bytes()).hexdigest()
    with pytest.raises(ModelError, match=r"gcp-multi\.onnx holds no device network"):
        devices_of(DeviceUNet(), KIND.path.with_name("gcp-multi.onnx"))


def test_size_of_the_network():
    assert 200_000 < sum(p.numel() for p in DeviceUNet().parameters()) < 500_000
