"""The loop that trainings share: what it minimises, keeps, passes over, and goes on from."""

import dataclasses
import json
import os
import signal

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the export extra")

from safetensors.torch import load_file  # noqa: E402

from gcar_deploy.errors import ModelError, UsageError  # noqa: E402
from gcar_export.training.loop import (  # noqa: E402
    Lesson,
    learn,
    learn_together,
    learning_rate,
)
from gcar_export.training.run_folder import RunFolder, heeding, read_log  # noqa: E402
from gcar_export.training.scene_stream import Terminated  # noqa: E402
from gcar_export.training.segmenter import TINY, SegmenterOptions  # noqa: E402

MANIFEST = {"network": "line", "config": {}, "seed": 1}


def options(**changed):
    given = {"steps": 60, "decay_steps": 30, "warmup_steps": 2, "learning_rate": 0.1,
             "weight_decay": 0.0, "mean_steps": 5, "save_every": 7}  # fmt: skip
    return SegmenterOptions(**(given | changed))


def lesson(net, losses=None, steps=60):
    """Fit y = 2 x - 1 exactly; of every third batch nothing is asked where ``losses`` counts."""

    def loss_of(k):
        if losses is not None and k % 3 == 0:
            return None
        x = torch.linspace(-1, 1, 5)[:, None] + 0.1 * (k % 4)
        loss = ((net(x) - (2 * x - 1)) ** 2).mean()
        if losses is not None:
            losses.append(float(loss.detach()))
        return loss

    return Lesson(
        lambda first: range(first, steps), loss_of,
        lambda mean, _: {"slope": float(mean.weight.detach())},
    )  # fmt: skip


def line():
    torch.manual_seed(3)
    return torch.nn.Linear(1, 1)


@pytest.mark.slow
def test_a_line_is_learned_and_its_mean_is_kept(tmp_path):
    net, losses = line(), []
    longer = options(steps=150, decay_steps=100)
    learn(RunFolder(tmp_path, MANIFEST), net, longer, lesson(net, losses, 150))
    assert len(losses) == 100 and losses[-1] < 0.02 < 1 < losses[0]
    kept = load_file(tmp_path / "checkpoint.safetensors")
    assert float(kept["mean.weight"]) == pytest.approx(2, abs=0.05)
    assert float(kept["mean.weight"]) != float(kept["net.weight"])
    told = json.loads((tmp_path / "manifest.json").read_text())
    assert told["step"] == 150 and told["validation"]["slope"] == float(kept["mean.weight"])


@pytest.mark.slow
def test_a_run_in_pieces_is_a_run_in_one(tmp_path):
    begun = []
    for name, pieces in (("one", [60]), ("two", [23, 60])):
        for steps in pieces:
            net = line()
            own = lesson(net, steps=steps)
            own = dataclasses.replace(
                own, batches=lambda k, n=steps: begun.append(k) or range(k, n)
            )
            learn(RunFolder(tmp_path / name, MANIFEST), net, options(), own)
    assert begun == [0, 0, 23]
    one, two = (load_file(tmp_path / name / "checkpoint.safetensors") for name in ("one", "two"))
    assert one.keys() == two.keys()
    for name, value in one.items():
        np.testing.assert_array_equal(value, two[name], err_msg=name)
    last = [read_log(tmp_path / name / "log.csv")[-1] for name in ("one", "two")]
    assert last[0] == last[1] and last[0]["step"] == "60"


@pytest.mark.parametrize("key", ["learning_rate", "batch", "scenes", "segmenter"])
def test_a_run_does_not_go_on_with_other_options(tmp_path, key):
    def manifest(**changed):
        given = {"options": dataclasses.asdict(options()), "scenes": {"noise": 1}, "segmenter": "a"}
        for name, value in changed.items():
            place = given["options"] if name in given["options"] else given
            place[name] = value
        return MANIFEST | given

    net = line()
    learn(RunFolder(tmp_path, manifest()), net, options(steps=1), lesson(net, steps=1))
    RunFolder(tmp_path, manifest(steps=90, decay_steps=3, save_every=1, validation_pictures=1))
    with pytest.raises(UsageError, match=rf"with {key} = .*, this one has {key} = .*same {key}"):
        RunFolder(tmp_path, manifest(**{key: 0.5}))
    older = json.loads((tmp_path / "manifest.json").read_text())
    del older["options"]["batch"]
    (tmp_path / "manifest.json").write_text(json.dumps(older))
    RunFolder(tmp_path, manifest())
    (tmp_path / "manifest.json").unlink()
    with pytest.raises(UsageError, match=r"\.safetensors has no manifest\.json beside it"):
        RunFolder(tmp_path, manifest())


@pytest.mark.parametrize("damage", ["cut off", "another network"])
def test_a_damaged_checkpoint_is_one_line(tmp_path, damage):
    net = line()
    learn(RunFolder(tmp_path, MANIFEST), net, options(steps=1), lesson(net, steps=1))
    file = tmp_path / "checkpoint.safetensors"
    if damage == "cut off":
        file.write_bytes(file.read_bytes()[:-50])
    else:
        net = torch.nn.Linear(2, 1)
    with pytest.raises(ModelError, match=r"checkpoint\.safetensors (cannot be read|does not fit)"):
        learn(RunFolder(tmp_path, MANIFEST), net, options(steps=2), lesson(net, steps=2))


def test_what_is_learned_is_saved_before_it_is_scored(tmp_path, capsys):
    """An end meanwhile, whichever, costs the scores alone: the next call gives them."""

    def ends(mean, _):
        raise MemoryError

    net = line()
    torn = dataclasses.replace(lesson(net), validate=ends)
    with pytest.raises(MemoryError):
        learn(RunFolder(tmp_path, MANIFEST), net, options(), torn)
    assert int(load_file(tmp_path / "checkpoint.safetensors")["step"]) == 60
    assert not RunFolder(tmp_path, MANIFEST).finished(60)
    told = capsys.readouterr().err
    assert "min left" not in told and "scoring follows" in told and "it is scored now" in told
    again = dataclasses.replace(lesson(net), loss_of=None)  # no step is taken
    learn(RunFolder(tmp_path, MANIFEST), net, options(), again)
    assert "slope" in json.loads((tmp_path / "manifest.json").read_text())["validation"]
    assert RunFolder(tmp_path, MANIFEST).finished(60)


#: what a training ends with after a signal: exit codes 130 and 143
ENDS = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: Terminated}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_scoring(tmp_path, capsys, number):
    seen = []

    def validate(mean, stop):
        for k in heeding(stop, range(9)):
            seen.append(k)
            if k == 2:
                signal.raise_signal(number)
        return {"slope": 0.0}

    net = line()
    own = dataclasses.replace(lesson(net, steps=1), validate=validate)
    both = [(RunFolder(tmp_path / name, MANIFEST), net, own) for name in "ab"]
    with pytest.raises(KeyboardInterrupt) as ended:
        learn_together(both, options(steps=1))
    assert ended.type is ENDS[number]
    assert seen == [0, 1, 2]
    said = capsys.readouterr().err
    for name in "ab":
        assert f"{tmp_path / name} is saved at step 1; the same command goes on" in said
        assert int(load_file(tmp_path / name / "checkpoint.safetensors")["step"]) == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_saves_where_it_is_and_a_second_ends_at_once(tmp_path, capsys, number):
    net = line()
    own = lesson(net)

    def pressed(times):
        def batches(first):
            for k in range(first, 60):
                if k == first + 3:
                    for _ in range(times):
                        signal.raise_signal(number)
                yield k

        return dataclasses.replace(own, batches=batches)

    before = signal.signal(number, signal.default_int_handler)
    with pytest.raises(KeyboardInterrupt) as ended:
        learn(RunFolder(tmp_path, MANIFEST), net, options(), pressed(1))
    assert ended.type is ENDS[number]
    assert f"{tmp_path} is saved at step 3; the same command goes on" in capsys.readouterr().err
    assert int(load_file(tmp_path / "checkpoint.safetensors")["step"]) == 3
    assert json.loads((tmp_path / "manifest.json").read_text())["step"] == 3
    with pytest.raises(KeyboardInterrupt):
        learn(RunFolder(tmp_path, MANIFEST), net, options(save_every=50), pressed(2))
    assert int(load_file(tmp_path / "checkpoint.safetensors")["step"]) == 3
    assert signal.signal(number, before) == signal.default_int_handler


def test_a_finished_run_says_that_it_is(tmp_path, capsys):
    net = line()
    for steps in (2, 2, 3):
        folder = RunFolder(tmp_path, MANIFEST)
        learn(folder, net, options(steps=steps), lesson(net, steps=steps))
    assert capsys.readouterr().err.count(f"{tmp_path} is finished: 2 steps") == 1
    assert int(load_file(tmp_path / "checkpoint.safetensors")["step"]) == 3


def test_a_first_checkpoint_is_never_without_its_manifest(tmp_path, monkeypatch):
    def cut_off(*_):
        assert json.loads((tmp_path / "manifest.json").read_text())["step"] == 1
        raise KeyboardInterrupt

    net = line()
    folder = RunFolder(tmp_path, MANIFEST)
    replace = os.replace
    monkeypatch.setattr(
        "os.replace", lambda a, b: cut_off() if b == folder.checkpoint else replace(a, b)
    )
    with pytest.raises(KeyboardInterrupt):
        learn(folder, net, options(steps=1), lesson(net, steps=1))


@pytest.mark.slow
def test_networks_that_learn_together_end_as_each_would_alone(tmp_path):
    """Also where an interruption left the first ahead of the second."""

    def pupils(root, steps):
        whole, part = line(), line()
        own, other = lesson(whole, steps=steps), lesson(part, [], steps)
        return [(RunFolder(root / "whole", MANIFEST), whole, own),
                (RunFolder(root / "part", MANIFEST), part, other)]  # fmt: skip

    for folder, net, own in pupils(tmp_path / "alone", 60):
        learn(folder, net, options(), own)
    for one, steps in ((0, 31), (1, 20)):
        folder, net, own = pupils(tmp_path / "both", steps)[one]
        learn(folder, net, options(), own)
    learn_together(pupils(tmp_path / "both", 60), options())
    ends = []
    for name in ("whole", "part"):
        alone, both = (
            load_file(tmp_path / root / name / "checkpoint.safetensors")
            for root in ("alone", "both")
        )
        ends.append(float(both["net.weight"]))
        for key, value in alone.items():
            np.testing.assert_array_equal(value, both[key], err_msg=f"{name} {key}")
    assert ends[0] != ends[1]


def test_a_gradient_that_is_not_finite_moves_nothing(tmp_path):
    net = line()
    before = net.weight.detach().clone()
    torn = Lesson(lambda first: range(first, 60), lambda k: (net(torch.ones(1, 1)) / 0).sum(),
                  lambda mean, _: {"slope": 0.0})  # fmt: skip
    learn(RunFolder(tmp_path, MANIFEST), net, options(), torn)
    torch.testing.assert_close(net.weight.detach(), before)


def test_schedule():
    given = TINY.__class__(steps=100, decay_steps=50, warmup_steps=10)
    rates = [learning_rate(given, k) for k in range(101)]
    assert rates[0] < rates[9] == rates[49] == given.learning_rate
    assert rates[75] == pytest.approx(given.learning_rate / 2) and rates[100] == 0
