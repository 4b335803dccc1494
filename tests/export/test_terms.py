"""Whose terms hold for a segmenter: of its pictures, and of what its networks began from."""

import dataclasses
import hashlib
import json
import shutil

import pytest

torch = pytest.importorskip("torch", reason="needs the export extra")

from gcar_deploy.errors import ModelError, UsageError  # noqa: E402
from gcar_deploy.imaging.net import KIND  # noqa: E402
from gcar_export.scenes.expert_pictures import MOST_NAMED, expert_pictures, named  # noqa: E402
from gcar_export.shipping import export_segmenter as exporting  # noqa: E402
from gcar_export.shipping.verify import verify_model  # noqa: E402
from gcar_export.training import segmenter  # noqa: E402
from gcar_export.training.terms import begun, license_of, trained_as  # noqa: E402
from tests.export.drawn_angiograms import write_drawn  # noqa: E402

SPEC = json.loads(KIND.path.with_suffix(".json").read_text())


def spec_at(path, **changed):
    """A model's spec without the model."""
    path.with_suffix(".json").write_text(json.dumps(SPEC | changed))
    return path


def checkpoint_at(folder, **manifest):
    folder.mkdir(exist_ok=True)
    (folder / "manifest.json").write_text(json.dumps({"config": {}, "data": "drawn"} | manifest))
    return folder / "checkpoint.safetensors"


def test_what_the_first_weights_were_trained_on_stays_said(tmp_path):
    own, real = SPEC["training"]["data"].split("; ")
    assert begun(KIND.path, own) == {"data": f"{own}; {real}"}
    assert begun(KIND.path, f"{own}; {real}") == {"data": f"{own}; {real}"}
    told = SPEC["training"]["devices"]["data"]
    assert begun(KIND.path, "lines", devices=True) == {"data": f"lines; {told}"}
    assert begun(None, own) == {"data": own}
    first = checkpoint_at(tmp_path, real={"1": "a"}, real_before={"1": "b" * 64, "2": "c"})
    assert begun(first, own) == {
        "data": f"{own}; drawn", "real_before": {"1": "a", "1 (bbbbbbbb)": "b" * 64, "2": "c"},
    }  # fmt: skip
    with pytest.raises(ModelError, match=r"n\.onnx: what it was trained on is not said"):
        begun(tmp_path / "n.onnx", own)


def test_terms_of_a_spec_go_on(tmp_path):
    """Word for word, from either network's model, and only once."""
    paid = spec_at(tmp_path / "m.onnx", license="CC-BY-NC-4.0")
    for first, devices in ((paid, KIND.path), (KIND.path, paid), (paid, paid)):
        training = exporting._training(first, devices)
        assert license_of(training) == "CC-BY-NC-4.0"
        second = spec_at(tmp_path / "n.onnx", training=training, license=license_of(training))
        assert license_of(exporting._training(second, second)) == "CC-BY-NC-4.0"
    assert license_of(exporting._training(KIND.path, KIND.path)) == SPEC["license"]
    assert begun(paid, "x")["licenses_before"] == ["CC-BY-NC-4.0"]
    more = spec_at(tmp_path / "o.onnx", license=SPEC["license"] + "; not for sale")
    assert license_of(exporting._training(more, KIND.path)).endswith("; not for sale")


def test_real_pictures_have_terms_of_their_own(tmp_path):
    real = checkpoint_at(tmp_path / "r", real={"1": "a"})
    licence = license_of(exporting._training(real, KIND.path))
    assert licence == "that of the pictures named in training.real"
    lines = checkpoint_at(tmp_path / "d", network="line-net", real_before={"1": "a"})
    licence = license_of(exporting._training(real, lines))
    assert licence.endswith("named in training.real and training.devices.real_before")
    # A run of an earlier version names the folder alone.
    older = checkpoint_at(tmp_path / "o", options={"real": "masks"})
    assert license_of(trained_as(older)) == "that of the pictures in masks"
    assert license_of({"data": "drawn"}) == "Apache-2.0; trained on drawn"


def test_a_run_names_its_real_pictures_and_goes_on_with_them_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(segmenter, "learn_together", lambda pupils, *_: [
        folder._write_manifest() for folder, *_ in pupils])  # fmt: skip
    write_drawn(tmp_path / "real", 4)
    options = dataclasses.replace(segmenter.TINY, real=str(tmp_path / "real"), folds=2)
    segmenter.train(tmp_path / "run", options)
    both = b"".join((tmp_path / "real" / name).read_bytes() for name in ("1.png", "1_gt.png"))
    kept = {
        name: json.loads((tmp_path / "run" / name / "manifest.json").read_text())["real"]
        for name in ("", "fold-1-of-2")
    }
    assert list(kept[""]) == ["1", "2", "3", "4"] and list(kept["fold-1-of-2"]) == ["3", "4"]
    assert kept[""]["1"] == hashlib.sha256(both).hexdigest()
    shutil.copy(tmp_path / "real" / "2.png", tmp_path / "real" / "1.png")
    with pytest.raises(UsageError, match=r"4 real pictures .*give another --out"):
        segmenter.train(tmp_path / "run", options)
    (one,) = expert_pictures(tmp_path / "real")[:1]
    many = [one] * 2 + [dataclasses.replace(one, name=str(k % 4 + 1)) for k in range(9)]
    assert len(named(tmp_path / "real", many)) == 4 <= MOST_NAMED
    monkeypatch.setattr("gcar_export.scenes.expert_pictures.MOST_NAMED", 3)
    assert list(named(tmp_path / "real", many)) == ["4 pictures of real"]


def test_a_model_without_its_golden_case_is_checked_in_form_alone(tmp_path):
    for suffix in (".onnx", ".json"):
        shutil.copy(KIND.path.with_suffix(suffix), tmp_path / f"m{suffix}")
    said = verify_model(tmp_path / "m.onnx", 1)
    assert "\nwarning: no golden case beside it: only its form was checked" in said
    assert "warning" not in verify_model(KIND.path, 1)


def test_a_licence_that_is_no_text_is_refused(tmp_path):
    for suffix in (".onnx", ".json"):
        shutil.copy(KIND.path.with_suffix(suffix), tmp_path / f"m{suffix}")
    model = spec_at(tmp_path / "m.onnx", license={"name": "CC-BY-NC-4.0"})
    for refused in (lambda: verify_model(model, 1), lambda: begun(model, "x")):
        with pytest.raises(ModelError, match=r"license = .*CC-BY-NC-4\.0.* is no text"):
            refused()
