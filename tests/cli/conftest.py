"""A good case on disk, and the command as a process of its own or in this one."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from gcar_deploy.selftest import tiny_case
from tests.battery.cases import geometry


@dataclasses.dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str


def gcar(*arguments: object) -> Outcome:
    """Run the command in this process, as ``main`` would."""
    from gcar_deploy.cli.main import main

    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([str(a) for a in arguments])
        except SystemExit as stop:
            code = stop.code
    assert isinstance(code, int)
    return Outcome(code, out.getvalue(), err.getvalue())


@contextlib.contextmanager
def full_disk(size: int = 512) -> Iterator[None]:
    """Let no file grow beyond so many bytes: what is longer fails in the middle."""
    resource = pytest.importorskip("resource", reason="needs POSIX")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture(scope="session")
def good_case(tmp_path_factory) -> Path:
    """Folder with view1.png, view2.png, geom.json of a small generated tree."""
    folder = tmp_path_factory.mktemp("case")
    angiograms, _, _ = tiny_case()
    for number, angiogram in enumerate(angiograms, start=1):
        cv2.imwrite(str(folder / f"view{number}.png"), angiogram.pixels.astype(np.uint16))
    (folder / "geom.json").write_text(json.dumps(geometry()))
    return folder
