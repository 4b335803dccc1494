from __future__ import annotations

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from gcar_deploy.cli.enhance import enhance
from gcar_deploy.errors import RefusedError, UsageError
from tests.imaging.phantoms import raw_picture, tube_paths


def _run(*arguments):
    return CliRunner().invoke(enhance, [str(a) for a in arguments])


@pytest.fixture
def picture(tmp_path):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), raw_picture(tube_paths()).astype(np.uint8))
    return path


def test_four_pictures_at_the_size_of_the_first(tmp_path, picture):
    out = tmp_path / "deep" / "steps"
    done = _run(picture, "--out", out, "--pixel-mm", 0.3)
    assert done.exit_code == 0, done.output
    names = ["manifest.json", "mask.png", "skeleton.png", "steps.png", "vesselness.png"]
    assert sorted(p.name for p in out.iterdir()) == names
    for path in out.glob("*.png"):
        assert cv2.imread(str(path), -1).shape[:2] == (256, 256)
    assert [p.name for p in out.parent.iterdir()] == ["steps"]


@pytest.mark.slow
def test_existing_folder_needs_force(tmp_path, picture):
    out = tmp_path / "steps"
    out.mkdir()
    (out / "mine.txt").write_text("x")
    for more in ((), ("--force",)):
        assert "mine.txt" in str(_run(picture, "--out", out, *more).exception)
        assert [p.name for p in out.iterdir()] == ["mine.txt"]
    (out / "mine.txt").unlink()
    assert isinstance(_run(picture, "--out", out).exception, UsageError)
    assert _run(picture, "--out", out, "--force").exit_code == 0
    assert _run(picture, "--out", out, "--force").exit_code == 0
    assert len(list(out.iterdir())) == 5


def test_nothing_is_written_on_refusal(tmp_path):
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full((64, 64), 9, np.uint8))
    assert isinstance(_run(blank, "--out", tmp_path / "o").exception, RefusedError)
    assert [p.name for p in tmp_path.iterdir()] == ["blank.png"]


def test_a_file_or_link_in_the_way_is_refused(tmp_path, picture):
    (tmp_path / "f").write_text("x")
    (tmp_path / "l").symlink_to(tmp_path)
    for name in ("f", "l"):
        done = _run(picture, "--out", tmp_path / name, "--force")
        assert isinstance(done.exception, UsageError)
