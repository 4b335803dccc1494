"""A file that cannot be reached or read ends with the exit code of its kind, and is named."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gcar_deploy import Engine
from gcar_deploy.errors import GcarError
from tests.cli.conftest import gcar

_LONG = "a" * 252 + ".png"
_ROOT = not hasattr(os, "geteuid") or os.geteuid() == 0


def _far(kind: str, folder: Path) -> Path:
    """Return a path to a file that is out of reach in its way."""
    if kind == "long name":
        return folder / _LONG
    if kind == "read error":
        memory = Path("/proc/self/mem")
        if not memory.exists():
            pytest.skip("no file here that opens and cannot be read")
        (folder / "view.png").symlink_to(memory)
        return folder / "view.png"
    if _ROOT:
        pytest.skip("nothing is out of root's reach")
    (folder / "shut").mkdir()
    (folder / "shut" / "view.png").write_bytes(b"")
    (folder / "shut").chmod(0)
    return folder / "shut" / "view.png"


@pytest.fixture(params=["long name", "read error", "shut folder"])
def far(request, tmp_path):
    path = _far(request.param, tmp_path)
    yield path
    if (tmp_path / "shut").exists():
        (tmp_path / "shut").chmod(0o755)


@pytest.mark.req("REQ-08")
def test_out_of_reach(far, good_case, tmp_path):
    view, geometry, out = good_case / "view1.png", good_case / "geom.json", tmp_path / "out"
    no_suffix = far.with_name(far.stem)
    calls = [
        (3, ["run", far, view, "--geom", geometry, "--out", out], far),
        (3, ["run", far.with_suffix(".tif"), view, "--geom", geometry, "--out", out], None),
        (3, ["run", far, view, "--out", out], far),
        (3, ["run", no_suffix, view, "--geom", geometry, "--out", out], None),
        (3, ["run", view, view, "--geom", geometry, "--mask", f"1:{far}", "--out", out], far),
        (3, ["validate", far, view, "--geom", geometry], far),
        (3, ["frames", far, far], far),
        (3, ["enhance", far, "--out", out], far),
        (3, ["open", far, view, "--geom", geometry, "--no-browser"], far),
        (4, ["run", view, view, "--geom", far, "--out", out], far),
        (2, ["run", "--order", far], far),
        (2, ["info", far], far),
        (2, ["info", far.with_suffix("")], None),
    ]
    for code, call, named in calls:
        found = gcar(*call)
        assert found.code == code, (call, found)
        assert len(found.err.splitlines()) == 1 and found.err.startswith("gcar: error: ")
        assert named is None or named.name in found.err
        assert not out.exists()
    with pytest.raises(GcarError) as caught:
        Engine(threads=1).reconstruct([str(far), str(view)], str(geometry))
    assert caught.value.exit_code == 3 and str(caught.value).startswith(f"{far.name}: ")
