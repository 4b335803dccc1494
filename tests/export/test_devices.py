"""Pictures with devices, the network that learns to tell them, and its way into the model."""

import dataclasses
import hashlib
import json
import shutil

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the export extra")

from safetensors.torch import save_file  # noqa: E402

from gcar_deploy.errors import ModelError, UsageError  # noqa: E402
from gcar_deploy.imaging.line_strips import POINT, LinePoints, near_points  # noqa: E402
from gcar_deploy.imaging.net import KIND, load_segmenter, open_segmenter  # noqa: E402
from gcar_export.scenes.cine import cine_pair  # noqa: E402
from gcar_export.scenes.device_pictures import (  # noqa: E402
    DEVICE,
    NO_VESSEL,
    NOT_ASKED,
    OTHER,
    VESSEL,
    device_picture,
    generator,
    labels,
    pooled_device_picture,
)
from gcar_export.scenes.drawn_devices import drawn_devices  # noqa: E402
from gcar_export.scenes.expert_pictures import expert_pictures  # noqa: E402
from gcar_export.shipping import export_segmenter as exporting  # noqa: E402
from gcar_export.shipping.export_segmenter import (  # noqa: E402
    export_segmenter,
    load_device_checkpoint,
    load_segmenter_checkpoint,
)
from gcar_export.training.devices import (  # noqa: E402
    TINY,
    chosen,
    points_loss,
    train,
    varied,
)
from gcar_export.training.networks.line_net import LineNet, no_vessel  # noqa: E402
from gcar_export.training.segmenter_start import devices_of, vessels_sha256  # noqa: E402


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


@pytest.mark.slow
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
    seen = set()
    for index in range(8):
        made = device_picture(3, index, segmenter, real)
        again = device_picture(3, index, segmenter, real)
        np.testing.assert_array_equal(made.lines.points, again.lines.points)
        assert made.lines.points.shape == (len(made.label), POINT)
        assert np.isfinite(made.lines.points).all()
        known = set(made.label.tolist())
        # Of a real picture's ground nobody says what it is.
        assert not known & ({OTHER} if index % 4 == 2 else {NO_VESSEL})
        seen |= known
    assert {VESSEL, DEVICE} <= seen


def test_what_a_line_is_where_vessels_and_devices_meet():
    vessel, device = np.zeros((2, 40, 40), bool)
    vessel[18:22], device[:, 8:12] = True, True
    device &= ~vessel
    told = labels(vessel, device, expert=False)
    assert (told[18:22] == VESSEL).all() and (told[17, 12:] == NOT_ASKED).all()
    assert told[17, 9] == NOT_ASKED and (told[:15, 8:12] == DEVICE).all()
    assert (told[:15, 20:] == OTHER).all()
    assert (labels(vessel, device, expert=True)[:15, 20:] == NO_VESSEL).all()


@pytest.mark.slow
def test_a_pooled_picture_is_drawn_once(segmenter, tmp_path):
    stream = generator("0", ())
    one, again = (pooled_device_picture(tmp_path, stream, 4, 3, segmenter, ()) for _ in range(2))
    np.testing.assert_array_equal(one.lines.points, again.lines.points)
    np.testing.assert_array_equal(one.label, again.label)
    made = device_picture(4, 3, segmenter)
    assert made.lines.lengths == one.lines.lengths
    np.testing.assert_array_equal(made.lines.near, one.lines.near)
    np.testing.assert_allclose(made.lines.points, one.lines.points, atol=4e-3)
    assert len(list(tmp_path.iterdir())) == 1


def _lines(rng):
    lengths = (5, 30, 12)
    points = rng.normal(size=(sum(lengths), POINT)).astype(np.float32)
    pixels = np.zeros((len(points), 2), int)
    return LinePoints(pixels, points, near_points(lengths), lengths)


def test_varied_lines_keep_points_and_labels_together():
    rng = np.random.default_rng(0)
    lines = _lines(rng)
    lines.points[:, -1] = np.arange(len(lines.points))  # a column that no variation changes
    label = np.arange(len(lines.points))
    found = [varied(np.random.default_rng(k), lines, label) for k in range(16)]
    for points, own in found:
        np.testing.assert_array_equal(points[:, -1], own)
        assert sorted(own[:5]) == [0, 1, 2, 3, 4]
    assert len({tuple(own) for _, own in found}) == 2
    assert len({points.tobytes() for points, _ in found}) == 4


def test_loss_is_least_at_the_truth():
    label = torch.tensor([VESSEL, DEVICE, OTHER, NOT_ASKED])
    right = 30 * torch.eye(4)[:, :3]
    assert points_loss(right, label) < 1e-3 < 1 < points_loss(right.roll(1, 0), label)
    vague = torch.tensor([NO_VESSEL])
    assert points_loss(right[1:2], vague) < 1e-3 and points_loss(right[2:3], vague) < 1e-3
    assert points_loss(right[:1], vague) > 10


def test_a_point_is_seen_with_its_own_line_alone():
    """A change on one line reaches another only by what all lines have in common."""
    torch.manual_seed(0)
    net = LineNet().eval()
    for common in net.common:
        torch.nn.init.zeros_(common.weight)
    lines = _lines(np.random.default_rng(1))
    points, near = torch.from_numpy(lines.points), torch.from_numpy(lines.near)
    other = points.clone()
    other[10] += 1
    with torch.no_grad():
        changed = (no_vessel(net(points, near)) - no_vessel(net(other, near))).abs() > 0
    assert changed[5:35].all() and not changed[:5].any() and not changed[35:].any()


def test_options():
    assert chosen({"fold": "1/2", "steps": 8}).fold == (1, 2)
    assert chosen({"validation_pictures": 3}).validation_pictures == 3
    assert chosen({"steps": 8}).decay_steps == 8 and chosen({"steps": 8}).warmup_steps == 2
    with pytest.raises(UsageError, match="must be K/N"):
        chosen({"fold": "first"})


@pytest.mark.slow
def test_from_training_to_the_model(segmenter, tmp_path, capsys):
    """It goes on where it stopped; in the model the vessels stay to the bit."""
    short = dataclasses.replace(TINY, steps=2)
    train(tmp_path / "run", short, pool=tmp_path / "pool")
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["step"] == 2
    train(tmp_path / "run", TINY, pool=tmp_path / "pool")
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert manifest["step"] == 3 and 0 <= manifest["validation"]["found"] <= 1
    out = tmp_path / "out" / "segmenter.onnx"
    checkpoint = tmp_path / "run" / "checkpoint.safetensors"
    assert export_segmenter(KIND.path, out, 2, checkpoint) < 1e-4
    spec = json.loads(out.with_suffix(".json").read_text())
    assert spec["training"]["devices"]["step"] == 3 and spec["name"] == "segmenter"
    names = {"segmenter.onnx", "segmenter.json", "segmenter.golden.npz"}
    assert {path.name for path in out.parent.iterdir()} == names
    channels = np.random.default_rng(0).normal(size=(3, 96, 112)).astype(np.float32)
    lines = _lines(np.random.default_rng(2))
    assert "another segmenter" not in capsys.readouterr().err
    new = open_segmenter(out, threads=1)
    assert new.session.check_golden() < 1e-6
    before, after = segmenter.look(channels), new.look(channels)
    np.testing.assert_array_equal(before.probability, after.probability)
    np.testing.assert_array_equal(before.chord, after.chord)
    assert (segmenter.devices(lines) != new.devices(lines)).any()
    # The next training stands on the same answers.
    assert vessels_sha256(KIND.path) == vessels_sha256(out)
    # Both networks of a model go into another one.
    again = tmp_path / "again.onnx"
    export_segmenter(out, again, 1, out)
    same = open_segmenter(again, threads=1)
    np.testing.assert_allclose(same.devices(lines), new.devices(lines), atol=1e-5)
    assert json.loads(again.with_suffix(".json").read_text())["training"] == spec["training"]


@pytest.mark.slow
def test_a_device_network_belongs_to_a_segmenter(tmp_path, capsys, recwarn):
    """Of another one it is said; one is trained for one's own."""
    net = load_segmenter_checkpoint(KIND.path)
    manifest = {"network": "mask-unet", "config": dataclasses.asdict(net.config), "data": ""}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    weights = {f"net.{name}": 1.001 * value for name, value in net.state_dict().items()}
    save_file(weights, tmp_path / "own.safetensors")
    own = tmp_path / "own.onnx"
    export_segmenter(tmp_path / "own.safetensors", own, 1)
    out, said = capsys.readouterr()
    assert "torch.onnx" not in out + said
    assert not [w for w in recwarn if "axis name" in str(w.message)]
    assert f"train-devices --segmenter-model {own} trains one for it" in said
    train(tmp_path / "run", TINY, segmenter_model=own)
    trained = tmp_path / "run" / "checkpoint.safetensors"
    kept = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert kept["segmenter"] == vessels_sha256(own) != vessels_sha256(KIND.path)
    capsys.readouterr()
    export_segmenter(own, tmp_path / "both.onnx", 1, trained)
    assert "another segmenter" not in capsys.readouterr().err
    with pytest.raises(UsageError, match="segmenter = "):
        train(tmp_path / "run", TINY)
    export_segmenter(KIND.path, tmp_path / "wrong.onnx", 1, tmp_path / "both.onnx")
    assert "another segmenter" in capsys.readouterr().err


@pytest.mark.slow
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
    with pytest.raises(ModelError, match=r"gcp-multi\.onnx holds no network of lines"):
        devices_of(LineNet(), KIND.path.with_name("gcp-multi.onnx"))


@pytest.mark.slow
def test_a_model_is_replaced_by_one_that_was_proved(tmp_path, monkeypatch):
    out = tmp_path / "segmenter.onnx"
    for path in exporting._files(KIND.path):
        shutil.copy(path, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr(exporting, "PARITY", -1.0)
    for place in (out, tmp_path / "new" / "m.onnx"):
        with pytest.raises(ModelError, match="differs from its checkpoint"):
            export_segmenter(KIND.path, place, 1)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_size_of_the_network():
    assert 100_000 < sum(p.numel() for p in LineNet().parameters()) < 300_000
