"""A good case on disk: the start of every damaged one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gcar_deploy.selftest import tiny_case


def geometry() -> dict[str, Any]:
    """Return the content of ``geom.json`` of the generated case."""
    angiograms, grid, _ = tiny_case()
    views: list[dict[str, Any]] = []
    for number, angiogram in enumerate(angiograms, start=1):
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
                "intensity": {"kind": "path_length", "polarity": "bright", "mm_per_count": 0.001},
            }
        )
    volume = {
        "center_mm": list(grid.center_mm),
        "size_mm": list(grid.size_mm),
        "shape": list(grid.shape),
    }
    return {"schema": "gcar-geometry/1", "frame": "LPS", "views": views, "volume": volume}


def pictures(scale: int = 1) -> list[bytes]:
    """PNG bytes of the two views, 16 bit; ``scale`` repeats every pixel."""
    out = []
    for angiogram in tiny_case()[0]:
        pixels = np.kron(angiogram.pixels, np.ones((scale, scale))).astype(np.uint16)
        out.append(cv2.imencode(".png", pixels)[1].tobytes())
    return out


def write_case(folder: Path) -> None:
    """Write view1.png, view2.png and geom.json."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, data in enumerate(pictures(), start=1):
        (folder / f"view{number}.png").write_bytes(data)
    (folder / "geom.json").write_text(json.dumps(geometry()))
