"""A run's folder that does not fit together, that is in use, or whose sitting is over."""

import dataclasses
import json

import pytest

torch = pytest.importorskip("torch", reason="needs the export extra")

from gcar_deploy.errors import UsageError  # noqa: E402
from gcar_export.training.loop import Lesson, learn  # noqa: E402
from gcar_export.training.run_folder import RunFolder, alone, read_log  # noqa: E402
from gcar_export.training.segmenter import TINY  # noqa: E402

MANIFEST = {"network": "line", "config": {}, "seed": 1}


def learned(path, steps=3, minutes=None):
    torch.manual_seed(1)
    net = torch.nn.Linear(1, 1)
    options = dataclasses.replace(TINY, steps=steps, save_every=100)
    lesson = Lesson(lambda first: range(first, steps), lambda k: net(torch.ones(1, 1)).sum(),
                    lambda mean, _: {"slope": 0.5})  # fmt: skip
    learn(RunFolder(path, MANIFEST), net, options, lesson, minutes)


@pytest.mark.parametrize("cut", [1, 2, 8])
def test_a_line_of_the_log_that_was_cut_off_is_no_score(tmp_path, capsys, cut):
    learned(tmp_path)
    log = tmp_path / "log.csv"
    whole = log.read_text()
    log.write_text(whole[:-cut])
    learned(tmp_path)
    assert "is finished" not in capsys.readouterr().err
    assert log.read_text().split(",")[-1] == whole.split(",")[-1] and len(read_log(log)) == 1
    learned(tmp_path)
    assert f"{tmp_path} is finished: 3 steps" in capsys.readouterr().err


def test_the_end_of_a_sitting_says_where_it_goes_on_and_the_last_one_its_score(tmp_path, capsys):
    learned(tmp_path, minutes=1e-9)
    said = capsys.readouterr().err
    assert f"{tmp_path} is saved at step 0; the same command goes on" in said
    learned(tmp_path, minutes=5)
    said = capsys.readouterr().err
    assert f"{tmp_path} at step 3: slope 0.500 (held out)" in said and "goes on" not in said


def test_a_checkpoint_of_another_step_than_its_manifest_is_said(tmp_path, capsys):
    learned(tmp_path)
    manifest = tmp_path / "manifest.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"step": 2}))
    learned(tmp_path)
    assert "checkpoint.safetensors is of step 3, its manifest.json of step 2: " in (
        capsys.readouterr().err
    )
    learned(tmp_path / "short", 1)
    (tmp_path / "short" / "checkpoint.safetensors").rename(tmp_path / "checkpoint.safetensors")
    learned(tmp_path)
    said = capsys.readouterr().err
    assert "is of step 1, its manifest.json of step" in said and "is finished" not in said
    learned(tmp_path)
    assert "is of step" not in capsys.readouterr().err


def test_a_run_without_its_checkpoint_is_said(tmp_path, capsys):
    learned(tmp_path)
    assert "begins anew" not in capsys.readouterr().err
    (tmp_path / "checkpoint.safetensors").unlink()
    learned(tmp_path)
    said = capsys.readouterr().err
    assert f"{tmp_path} has manifest.json and log.csv but no checkpoint.safetensors: " in said


def test_a_folder_that_holds_something_else_is_refused(tmp_path):
    (tmp_path / "log.csv").write_text("mine")
    with pytest.raises(UsageError, match="exists and holds no training; give another --out"):
        learned(tmp_path)
    assert [f.name for f in tmp_path.iterdir()] == ["log.csv"]
    (tmp_path / "manifest.json").write_text("[1]")
    with pytest.raises(UsageError, match="is not that of a training"):
        learned(tmp_path)
    assert (tmp_path / "log.csv").read_text() == "mine"
    # Killed before its first checkpoint, a training goes on.
    for name in ("a/pool", "a/fold-1-of-2"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "a" / "run.lock").write_text("")
    learned(tmp_path / "a")
    learned(tmp_path / "a")


def test_a_folder_in_which_another_training_is_at_work_is_refused(tmp_path):
    with alone([RunFolder(tmp_path / "a", MANIFEST)]):
        with pytest.raises(UsageError, match=r"another training \(process \d+\) is at work in"):
            learned(tmp_path / "a")
        assert not (tmp_path / "a" / "checkpoint.safetensors").exists()
    (tmp_path / "a" / "checkpoint.safetensors.4194304.tmp").write_text("half")
    learned(tmp_path / "a")
    assert not list((tmp_path / "a").glob("*.tmp"))
