"""Files appear whole or not at all, and a full disk is said with the file's name."""

import errno
import multiprocessing

import pytest

pytest.importorskip("torch", reason="needs the export extra")

from gcar_deploy.files import whole_file
from gcar_export.training import segmenter
from gcar_export.training.loop import _Run

FULL = OSError(errno.ENOSPC, "No space left on device")


def test_what_fails_leaves_the_old_file_and_nothing_beside_it(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(OSError, match="No space left") as caught, whole_file(path) as partial:
        partial.write_text("half")
        raise FULL
    assert caught.value.filename == str(path)
    other = OSError(errno.ENOENT, "No such file", "elsewhere")
    with pytest.raises(FileNotFoundError) as caught, whole_file(path) as partial:
        raise other
    assert caught.value.filename == "elsewhere"
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    with whole_file(path) as partial:
        partial.write_text("new")
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


def test_an_error_of_a_process_that_draws_ends_the_training_with_its_file(tmp_path, monkeypatch):
    def full(folder, seed, index):
        raise OSError(*FULL.args, str(folder / "1.npz"))

    monkeypatch.setattr(segmenter, "pooled", full)
    with pytest.raises(OSError, match="No space left") as caught:
        segmenter.train(tmp_path / "run", segmenter.TINY, workers=1)
    assert caught.value.filename == str(tmp_path / "run" / "pool" / "1.npz")
    # They heed no signal: what still runs here would be waited for at the end of the process.
    assert not multiprocessing.active_children()


def test_any_error_ends_the_processes_that_draw(tmp_path, monkeypatch):
    def wrong(folder, seed, index):
        raise ValueError("no picture")

    monkeypatch.setattr(segmenter, "pooled", wrong)
    with pytest.raises(ValueError, match="no picture") as caught:
        segmenter.train(tmp_path / "run", segmenter.TINY, workers=1)
    assert caught.value is not None and not multiprocessing.active_children()


def test_a_disk_that_is_full_at_the_checkpoint_is_said_with_its_name(tmp_path, monkeypatch):
    def full(self, run=_Run.save):
        monkeypatch.setattr("gcar_export.training.run_folder.save", _no_space)
        run(self)

    monkeypatch.setattr(_Run, "save", full)
    with pytest.raises(OSError, match="No space left") as caught:
        segmenter.train(tmp_path / "run", segmenter.TINY)
    assert caught.value.filename == str(tmp_path / "run" / "checkpoint.safetensors")
    assert not list((tmp_path / "run").glob("*.tmp"))


def _no_space(data):
    raise FULL
