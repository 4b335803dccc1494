"""Thousands of good and bad cases in one warm process: memory, threads and files stay.

The largest case comes first: buffers of the libraries (ONNX Runtime's, OpenCV's, the C
library's heap) grow in steps to the largest case that was seen, and would else be taken for a
leak. The slope is that of resident memory over the cases after a plateau.
"""

from __future__ import annotations

import gc
import json
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np

from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError
from tests.battery.cases import geometry, pictures
from tests.battery.damage import changed, damaged

#: MB per 100 cases
MOST_SLOPE = 1.0
#: share of the cases that are bad, and of the cases that settle before the slope is measured
BAD, PLATEAU = 0.7, 0.2
_SCALES = (1, 2, 4)


def soak(count: int, seed: int) -> int:
    """Run ``count`` cases; return the number of findings."""
    rng = random.Random(seed)
    engine = Engine(threads=1)
    scenes = {scale: _scaled(scale) for scale in _SCALES}
    outcomes: Counter[str] = Counter()
    memory, threads, files = [], [], []
    with tempfile.TemporaryDirectory(prefix="gcar-soak-") as name:
        folder = Path(name)
        for scale in sorted(_SCALES, reverse=True):
            _one(engine, folder, *scenes[scale], None)
        first = _reference(engine, folder, scenes)
        with click.progressbar(range(count), label="soak", file=sys.stderr) as bar:
            for _ in bar:
                views, scene = scenes[rng.choice(_SCALES)]
                outcomes[_one(engine, folder, views, scene, rng)] += 1
                memory.append(_resident_mb())
                threads.append(_staying_threads(threads))
                files.append(len(list(Path("/proc/self/fd").iterdir())))
        same = _reference(engine, folder, scenes) == first
    return _judge(np.array(memory), np.array(threads), np.array(files), outcomes, same)


def _judge(
    memory: np.ndarray,
    threads: np.ndarray,
    files: np.ndarray,
    outcomes: Counter[str],
    same: bool,
) -> int:
    start = int(PLATEAU * len(memory))
    index = np.arange(start, len(memory))
    slope = float(np.polyfit(index, memory[start:], 1)[0]) * 100
    # A sawtooth of the heap tilts a short line: halves compared say the same more robustly.
    middle = (start + len(memory)) // 2
    growth = float(np.median(memory[middle:]) - np.median(memory[start:middle]))
    growth *= 100 / max((len(memory) - start) / 2, 1)
    counts = ", ".join(f"{name} {n}" for name, n in outcomes.most_common())
    click.echo(f"{len(memory)} cases: {counts}")
    click.echo(
        f"resident memory {memory[0]:.0f} MB at first, {memory[start]:.0f} after the plateau of "
        f"{start} cases, {memory[-1]:.0f} at last; slope {slope:+.3f} MB per 100 cases "
        f"(median of halves {growth:+.3f})"
    )
    click.echo(
        f"threads {threads[start:].min()} .. {threads[start:].max()}, "
        f"open files {files[start:].min()} .. {files[start:].max()}, "
        f"first case again: {'same bytes' if same else 'OTHER BYTES'}"
    )
    wrong = [
        text
        for text, bad in (
            (f"memory grows by {slope:.2f} MB per 100 cases", slope > MOST_SLOPE),
            ("threads are not constant", np.ptp(threads[start:]) > 0),
            ("open files are not constant", np.ptp(files[start:]) > 0),
            ("the first case gives other bytes at the end", not same),
            ("no good case", not any(name in ("ok", "degraded") for name in outcomes)),
        )
        if bad
    ]
    wrong += [name for name in outcomes if name.startswith("FINDING")]
    for text in wrong:
        click.echo(f"    {text}")
    click.echo(f"findings: {len(wrong)}")
    return len(wrong)


def _one(
    engine: Engine, folder: Path, views: list[bytes], scene: dict, rng: random.Random | None
) -> str:
    """Reconstruct a good case, or one with a damaged picture or geometry."""
    views = list(views)
    text = json.dumps(scene).encode()
    if rng is not None and rng.random() < BAD:
        if rng.random() < 0.5:
            views[rng.randrange(2)] = damaged(views[0], rng)
        else:
            text = json.dumps(changed(scene, rng)).encode("utf-8", "surrogatepass")
    paths = [folder / f"view{k}.png" for k in (1, 2)]
    for path, data in zip(paths, views, strict=True):
        path.write_bytes(data)
    (folder / "geom.json").write_bytes(text)
    try:
        result = engine.reconstruct(paths, folder / "geom.json")
        result.save(folder / "out", force=True)
    except GcarError as error:
        return f"refused {error.exit_code}"
    except MemoryError:
        return "FINDING out of memory"
    except Exception as error:  # noqa: BLE001 - what is looked for
        return f"FINDING {type(error).__name__}"
    return result.status


def _reference(engine: Engine, folder: Path, scenes: dict) -> bytes:
    _one(engine, folder, *scenes[1], None)
    return (folder / "out" / "centerline.csv").read_bytes()


def _scaled(scale: int) -> tuple[list[bytes], dict]:
    """Return the case at ``scale`` times the pixels, each so much smaller."""
    scene = geometry()
    for view in scene["views"]:
        view["rows"], view["columns"] = view["rows"] * scale, view["columns"] * scale
        view["pixel_spacing_mm"] = [s / scale for s in view["pixel_spacing_mm"]]
    return pictures(scale), scene


def _resident_mb() -> float:
    gc.collect(0)
    return _status("VmRSS") / 1024


def _staying_threads(before: Sequence[int]) -> int:
    """Threads of this process; one that was joined may take a moment to leave it."""
    until = time.monotonic() + 1.0
    while (count := _status("Threads")) > (before[-1] if before else count):
        if time.monotonic() > until:
            break
        time.sleep(0.005)
    return count


def _status(key: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{key}:"):
            return int(line.split()[1])
    raise KeyError(key)
