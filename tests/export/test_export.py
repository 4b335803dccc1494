"""From a checkpoint of any size to ONNX: both networks, extremes, the task, int8, refusals."""

import hashlib
import json

import pytest
import torch
from click.testing import CliRunner
from safetensors.torch import load_file, save_file

from gcar_deploy.errors import ModelError
from gcar_deploy.predict.kinds import read_predictor
from gcar_export.cli.main import main
from gcar_export.shipping import parity as parity_module
from gcar_export.shipping.export_onnx import export_model, load_checkpoint
from gcar_export.shipping.parity import Parity, accept, export_checked, parity
from gcar_export.shipping.quantize import quantize_checked
from gcar_export.shipping.task_check import task_measure, torch_predictor
from gcar_export.shipping.tiny_model import TINY, TINY_PAPER, write_tiny_checkpoint
from gcar_export.shipping.verify import verify_model
from gcar_export.training.networks.sparse import SparseConfig
from gcar_export.training.networks.unet import UNetConfig

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", params=["sparse", "unet"])
def exported(request, tmp_path_factory):
    """A tiny checkpoint of one network, exported and checked."""
    folder = tmp_path_factory.mktemp(request.param)
    checkpoint = write_tiny_checkpoint(folder, seed=3, network=request.param)
    found = export_checked(checkpoint, folder / "m.onnx", inputs=9, task_scenes=2)
    return checkpoint, folder / "m.onnx", found


def test_a_checkpoint_of_another_size_goes_through(exported):
    checkpoint, model, found = exported
    config = load_checkpoint(checkpoint).config
    assert config in (TINY, TINY_PAPER) and config not in (SparseConfig(), UNetConfig())
    assert found.inputs == 9 and found.worst < 1e-4 and found.decisions_equal > 0.9999
    assert found.task_torch == pytest.approx(found.task_runtime, abs=1e-3)
    spec = read_predictor(model).spec
    assert spec["name"] == "m" and spec["opset"] == 18 and spec["ir_version"] == 10
    assert spec["sha256"] == hashlib.sha256(model.read_bytes()).hexdigest()
    assert {f.name for f in model.parent.iterdir()} == {
        "checkpoint.safetensors", "manifest.json", "m.onnx", "m.json", "m.golden.npz",
    }  # fmt: skip


def test_a_model_is_replaced_only_when_asked(exported):
    checkpoint, model, _ = exported
    before = model.read_bytes()
    done = CliRunner().invoke(main, ["export", str(checkpoint), "--out", str(model)])
    assert done.exit_code == 2 and done.output == (
        f"gcar-export: error: {model} exists; add --force to replace it\n"
    )
    assert model.read_bytes() == before
    arguments = ["export", str(checkpoint), "--out", str(model), "--force", "--inputs", "1"]
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0
    # The predictor of all views has a Dice, and an untrained one a low one.
    warned = "is it trained?" in done.stderr
    assert warned == (read_predictor(model).kind == "multi")


@pytest.mark.parametrize("network", ["sparse", "unet"])
def test_nothing_of_torch_own_troubles_is_printed(tmp_path, capfd, recwarn, network):
    export_model(write_tiny_checkpoint(tmp_path, network=network), tmp_path / "m.onnx")
    assert "torchvision" not in capfd.readouterr().err
    assert not [str(w.message) for w in recwarn]


def test_card_of_the_file_is_that_of_the_spec(exported):
    import onnx

    graph = onnx.load(str(exported[1]))
    card = {entry.key: entry.value for entry in graph.metadata_props}
    spec = read_predictor(exported[1]).spec
    assert card == {f"gcar.{k}": spec[k] for k in ("schema", "name", "kind", "license")}
    assert graph.ir_version == 10 and graph.opset_import[0].version == 18
    assert not any(t.data_location for t in graph.graph.initializer)


def test_other_weights_are_noticed(exported, tmp_path):
    checkpoint, model, _ = exported
    data = load_file(checkpoint)
    key = next(k for k in data if k.endswith("head.bias") or k.endswith("head.1.bias"))
    data[key] = data[key] + 0.01
    save_file(data, tmp_path / "checkpoint.safetensors")
    (tmp_path / "manifest.json").write_text((checkpoint.parent / "manifest.json").read_text())
    assert parity(tmp_path / "checkpoint.safetensors", model, 5).worst > 1e-4


def test_a_graph_that_differs_leaves_no_file(tmp_path, monkeypatch):
    checkpoint = write_tiny_checkpoint(tmp_path, network="unet")
    monkeypatch.setattr(parity_module, "PARITY", -1.0)
    with pytest.raises(ModelError, match="differs from its checkpoint"):
        export_checked(checkpoint, tmp_path / "out" / "n.onnx", inputs=2, task_scenes=0)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (
            Parity(60, 2e-4, 1.0, 0.7, 0.7),
            r"checkpoint by 2.0e-04 of the range \(at most 0.0001\)$",
        ),
        (
            Parity(60, 1e-6, 0.9998, 0.7, 0.7),
            r"checkpoint in its decisions: 99.9800% of them are equal \(at least 99.99%\)$",
        ),
        (
            Parity(60, 1e-6, 1.0, 0.7, 0.69),
            "reaches 0.6900 through the runtime.*0.7000: more than 0.001 apart",
        ),
        (Parity(60, float("nan"), 1.0, 0.7, 0.7), "differs"),
    ],
)
def test_what_is_refused_and_why(found, words):
    with pytest.raises(ModelError, match=words):
        accept("m.onnx", found)


def test_task_is_measured_through_the_runtime(exported):
    checkpoint, model, _ = exported
    assert task_measure(torch_predictor(checkpoint, model), 1) == pytest.approx(
        task_measure(read_predictor(model), 1), abs=1e-6
    )
    text = verify_model(model, 1)
    kind = read_predictor(model).kind
    named = "share of lone centres within 1.5 pixels" if kind == "paper" else "Dice at 0.5 on the"
    assert named in text and read_predictor(model).sha256 in text


def test_int8_is_kept_or_refused_with_figures(exported, monkeypatch):
    model = exported[1]
    before = model.read_bytes()
    twin = model.with_name("m-int8.onnx")
    monkeypatch.setattr("gcar_export.shipping.quantize.MOST_LOST", 0.5)
    said = quantize_checked(model, scenes=1, calibration=2)
    assert "int8 accepted, Dice 0." in said and read_predictor(twin).spec["precision"].startswith(
        "int8"
    )
    monkeypatch.setattr("gcar_export.shipping.quantize.MOST_LOST", -1.0)
    with pytest.raises(ModelError, match=r"int8 refused: Dice 0\.\d+ -> 0\.\d+ over 1 scenes"):
        quantize_checked(model, scenes=1, calibration=2)
    assert not twin.exists() and not twin.with_suffix(".json").exists()
    assert model.read_bytes() == before


@pytest.mark.parametrize("manifest", [None, "{", json.dumps({"network": "unet", "config": {}})])
def test_a_checkpoint_without_a_usable_manifest_is_refused(tmp_path, manifest):
    save_file({"step": torch.zeros(1)}, tmp_path / "c.safetensors")
    if manifest is not None:
        (tmp_path / "manifest.json").write_text(manifest)
    with pytest.raises(ModelError, match=r"manifest\.json"):
        load_checkpoint(tmp_path / "c.safetensors")
