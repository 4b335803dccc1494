"""Geometry files: values, keys, tokens, bytes."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

import numpy as np

from gcar_deploy.geometry.scene import load_scene
from tests.battery.cases import geometry
from tests.battery.damage import TOKENS, changed, damaged
from tests.battery.kinds.common import generator, outcome
from tests.battery.pool import Case, FoundError


def make(seed: int) -> Case:
    """Return the fuzz case of geometry files."""
    good = geometry()

    def case(index: int, folder: Path) -> str:
        rng = generator("json", seed, index)
        path = folder / "geom.json"
        path.write_bytes(_spoilt(good, rng))
        return outcome(folder, (4,), lambda: _load(path))

    return case


def _load(path: Path) -> str:
    scene = load_scene(path)
    grid = scene.volume_grid()
    numbers = [grid.affine() if hasattr(grid, "affine") else grid.size_mm]
    numbers += [view.carm.project(np.zeros((1, 3)))[0] for view in scene.views]
    if not all(np.isfinite(np.asarray(n, dtype=float)).all() for n in numbers):
        raise FoundError("a scene that is not finite was accepted")
    return "accepted"


def _spoilt(good: dict[str, Any], rng: random.Random) -> bytes:
    kind = rng.random()
    value = changed(good, rng) if kind < 0.7 else good
    text = json.dumps(value, ensure_ascii=rng.random() < 0.8)
    data = text.encode("utf-8", "surrogatepass")
    if 0.6 < kind < 0.9:
        at = rng.randrange(len(data))
        data = data[:at] + rng.choice(TOKENS) + data[at + rng.choice((0, 1, 5)) :]
    if kind > 0.8:
        data = damaged(data, rng)
    if kind > 0.99:
        data = text.encode(rng.choice(("utf-16", "utf-32", "utf-8-sig")))
    return data
