"""A good case on disk, and the command as a process of its own or in this one."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gcar_deploy.selftest import tiny_case


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


@pytest.fixture(scope="session")
def good_case(tmp_path_factory) -> Path:
    """Folder with view1.png, view2.png, geom.json of a small generated tree."""
    folder = tmp_path_factory.mktemp("case")
    angiograms, grid, _ = tiny_case()
    views: list[dict[str, Any]] = []
    for number, angiogram in enumerate(angiograms, start=1):
        cv2.imwrite(str(folder / f"view{number}.png"), angiogram.pixels.astype(np.uint16))
        carm = angiogram.carm
        views.append(
            {
                "id": str(number),
                "primary_angle_deg": carm.primary_angle_deg,
                "secondary_angle_deg": carm.secondary_angle_deg,
                "sod_mm": carm.sod_mm,
                "sdd_mm": carm.sdd_mm,
                "rows": carm.rows,
                "columns": carm.columns,
                "pixel_spacing_mm": list(carm.pixel_spacing_mm),
                "intensity": {
                    "kind": "path_length", "polarity": "bright", "mm_per_count": 0.001,
                },
            }
        )  # fmt: skip
    geometry = {
        "schema": "gcar-geometry/1",
        "frame": "LPS",
        "views": views,
        "volume": {
            "center_mm": list(grid.center_mm),
            "size_mm": list(grid.size_mm),
            "shape": list(grid.shape),
        },
    }
    (folder / "geom.json").write_text(json.dumps(geometry))
    return folder
