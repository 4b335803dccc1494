"""Checkpoints from elsewhere: refused in one line, and no pickle is ever opened."""

from __future__ import annotations

import dataclasses
import json
import pickle

import numpy as np
import pytest
from click.testing import CliRunner

torch = pytest.importorskip("torch", reason="needs the export extra")
from safetensors.torch import load_file, save_file  # noqa: E402

from gcar_deploy.errors import ModelError  # noqa: E402
from gcar_deploy.imaging.net import KIND  # noqa: E402
from gcar_export.cli.main import main  # noqa: E402
from gcar_export.shipping.export_onnx import load_checkpoint  # noqa: E402
from gcar_export.shipping.export_segmenter import load_segmenter_checkpoint  # noqa: E402
from gcar_export.shipping.tiny_model import write_tiny_checkpoint  # noqa: E402
from gcar_export.training.networks.mask_unet import MaskUNet, MaskUNetConfig  # noqa: E402


@pytest.fixture
def checkpoint(tmp_path):
    return write_tiny_checkpoint(tmp_path)


class _Canary:
    def __reduce__(self):
        return (pytest.fail, ("a pickle was run",))


def config(key, value):
    def change(path):
        file = path.parent / "manifest.json"
        manifest = json.loads(file.read_text())
        manifest["config"][key] = value
        file.write_text(json.dumps(manifest))

    return change


def tensor(make):
    def change(path):
        data = load_file(path)
        name = next(k for k in data if k.startswith("net."))
        make(data, name)
        save_file(data, path)

    return change


def poisoned(data, name):
    data[name] = torch.full_like(data[name], float("nan"))


def reshaped(data, name):
    data[name] = torch.zeros(1, 2, 3)


WRONG = {
    "a pickle named so": lambda p: p.write_bytes(pickle.dumps(_Canary())),
    "torch.save named so": lambda p: torch.save({"net.a": torch.zeros(1)}, p),
    "empty": lambda p: p.write_bytes(b""),
    "cut off": lambda p: p.write_bytes(p.read_bytes()[:-100]),
    "a header of gigabytes": lambda p: p.write_bytes(b"\xff" * 7 + b"\x7f" + b"{}"),
    "text": lambda p: p.write_bytes(b"hello world" * 20),
    "not finite": tensor(poisoned),
    "a layer missing": tensor(lambda data, name: data.pop(name)),
    "a layer of another shape": tensor(reshaped),
    "no manifest": lambda p: (p.parent / "manifest.json").unlink(),
    "manifest not JSON": lambda p: (p.parent / "manifest.json").write_text("{"),
    "manifest a list": lambda p: (p.parent / "manifest.json").write_text("[]"),
    "manifest with NaN": lambda p: (p.parent / "manifest.json").write_text('{"config": NaN}'),
    "a wide network": config("width", [10**9] * 4),
    "another network": config("width", [5, 2, 2, 2]),
    "an unknown option": config("depth", 3),
    "text for a width": config("width", "wide"),
    "no width": config("width", None),
}


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.req("REQ-19")
def test_wrong_checkpoints_are_refused(checkpoint, name):
    WRONG[name](checkpoint)
    with pytest.raises(ModelError) as caught:
        load_checkpoint(checkpoint)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


@pytest.mark.req("REQ-19")
def test_pickles_are_not_even_opened(tmp_path):
    for suffix in (".pt", ".pth", ".ckpt", ".bin", ".npz"):
        path = tmp_path / f"m{suffix}"
        path.write_bytes(pickle.dumps(_Canary()))
        write_tiny_checkpoint(tmp_path)
        with pytest.raises(ModelError, match="pickles are not read"):
            load_checkpoint(path)


@pytest.mark.req("REQ-23")
def test_the_command_says_it_in_one_line_and_leaves_nothing(checkpoint, tmp_path):
    checkpoint.write_bytes(np.random.default_rng(0).bytes(300))
    out = tmp_path / "out" / "m.onnx"
    done = CliRunner().invoke(main, ["export", str(checkpoint), "--out", str(out)])
    assert done.exit_code == 5 and "Traceback" not in done.output
    assert done.output.startswith("gcar-export: error: checkpoint") and done.output.count("\n") == 1
    assert not out.parent.exists()


@pytest.mark.parametrize(
    ("network", "words", "said"),
    [("mask-unet", "export", "the segmenter: use it with export-segmenter"),
     ("line-net", "export", "the device network: use it with export-segmenter --devices"),
     ("sparse", "export-segmenter", "a predictor: use it with export"),
     ("line-net", "export-segmenter", "the device network: use it with export-segmenter --devices"),
     ("mask-unet", "export-segmenter MODEL --devices", "the segmenter: use it with "
      "export-segmenter"),
     ("unet", "export-segmenter MODEL --devices", "a predictor: use it with export")],
)  # fmt: skip
def test_a_checkpoint_of_another_kind_is_sent_where_it_belongs(checkpoint, network, words, said):
    file = checkpoint.parent / "manifest.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"network": network}))
    out = checkpoint.parent / "out" / "m.onnx"
    given = [str(KIND.path) if word == "MODEL" else word for word in words.split()]
    done = CliRunner().invoke(main, [*given, str(checkpoint), "--out", str(out)])
    assert (done.exit_code, done.output) == (
        5, f"gcar-export: error: {checkpoint} is a checkpoint of {said}\n"
    )  # fmt: skip
    assert not out.parent.exists()


@pytest.mark.parametrize("damage", ["cut off", "no manifest", "a layer missing", "a wide network"])
def test_wrong_checkpoints_of_the_segmenter_are_refused(tmp_path, damage):
    net = MaskUNet(MaskUNetConfig())
    path = tmp_path / "checkpoint.safetensors"
    save_file({f"net.{k}": v.contiguous() for k, v in net.state_dict().items()}, path)
    manifest = {"network": "mask-unet", "config": dataclasses.asdict(net.config)}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    load_segmenter_checkpoint(path)
    WRONG[damage](path)
    with pytest.raises(ModelError):
        load_segmenter_checkpoint(path)


@pytest.mark.parametrize("verb", ["train-segmenter", "train-devices"])
def test_first_weights_that_cannot_be_read_are_one_line(tmp_path, verb):
    for name in ("torn.onnx", "torn.safetensors"):
        (tmp_path / name).write_bytes(b"no weights at all")
        given = ["--warm-start", str(tmp_path / name), "--out", str(tmp_path / "run")]
        done = CliRunner().invoke(main, [verb, *given])
        assert done.exit_code == 5 and done.output.count("\n") == 1, done.output
        assert name in done.output and "internal" not in done.output
