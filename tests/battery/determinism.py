"""The same input gives the same bytes: cold and warm, whatever the hash seed.

One SHA-256 of tree, Gaussians and volume per number of threads; between numbers of threads the
largest relative difference is at most 1e-6.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import click
import numpy as np

_ROOT = Path(__file__).parents[2]
#: largest difference between numbers of threads, as a share of the largest value
BETWEEN_THREADS = 1e-6
_CHILD = """
import hashlib, json, sys
import numpy as np
from gcar_deploy.engine import Engine
from gcar_deploy.selftest import tiny_case
threads, repeats, case = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
engine = Engine(threads=threads)
out = []
for _ in range(repeats):
    if case == "tiny":
        pictures, grid, _ = tiny_case()
        result = engine.reconstruct(pictures, grid)
    else:
        from gcar_deploy.data.demo_case import demo_case
        demo = demo_case()
        result = engine.reconstruct(demo.pictures, demo.geometry)
    g = result.gaussians
    arrays = [result.volume, result.tree.points(), g.means_mm,
              *(np.concatenate([getattr(b, n) for b in result.tree.branches])
                for n in ("radius_mm", "sigma_mm", "confidence"))]
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    out.append(digest.hexdigest())
np.savez(sys.argv[4], *arrays)
print(json.dumps({"hashes": out, "status": result.status}))
"""


def determinism(repeats: int, threads: tuple[int, ...], hash_seeds: int, case: str) -> int:
    """Run all of them; return the number of findings.

    Parameters
    ----------
    repeats : processes (cold) and, in the first of them, runs (warm), per number of threads
    hash_seeds : how many values of PYTHONHASHSEED the processes take turns with
    case : ``tiny`` or ``demo``
    """
    import tempfile

    found: list[str] = []
    answers: dict[int, list[np.ndarray]] = {}
    with tempfile.TemporaryDirectory(prefix="gcar-same-") as name:
        for count in threads:
            hashes, states = set(), set()
            with click.progressbar(
                range(repeats), label=f"{count} threads", file=sys.stderr
            ) as bar:
                for k in bar:
                    file = Path(name) / f"{count}-{k}.npz"
                    said = _child(count, repeats if k == 0 else 1, case, file, k % hash_seeds)
                    hashes |= set(said["hashes"])
                    states.add(said["status"])
                    with np.load(file) as arrays:
                        answers[count] = [arrays[n] for n in arrays.files]
            click.echo(
                f"{count} threads: {repeats} cold and {repeats} warm runs, "
                f"{min(hash_seeds, repeats)} hash seeds: {len(hashes)} hash "
                f"({sorted(hashes)[0][:12]}), status {', '.join(sorted(states))}"
            )
            if len(hashes) != 1 or len(states) != 1:
                found.append(f"{count} threads: {len(hashes)} different results")
    for count in threads[1:]:
        apart = _apart(answers[threads[0]], answers[count])
        click.echo(f"{threads[0]} against {count} threads: largest relative difference {apart:.1e}")
        if not apart <= BETWEEN_THREADS:
            found.append(f"{count} threads differ by {apart:.1e}")
    for finding in found:
        click.echo(f"    {finding}")
    click.echo(f"findings: {len(found)}")
    return len(found)


def _child(threads: int, repeats: int, case: str, file: Path, hash_seed: int) -> dict:
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment = {**os.environ, **dict.fromkeys(names, str(threads))}
    environment["PYTHONHASHSEED"] = str(hash_seed)
    done = subprocess.run(
        [sys.executable, "-c", _CHILD, str(threads), str(repeats), case, str(file)],
        capture_output=True, text=True, check=True, cwd=_ROOT, env=environment,
    )  # fmt: skip
    said: dict = json.loads(done.stdout.splitlines()[-1])
    return said


def _apart(a: list[np.ndarray], b: list[np.ndarray]) -> float:
    worst = 0.0
    for x, y in zip(a, b, strict=True):
        if x.shape != y.shape:
            return float("inf")
        known = np.isfinite(x) & np.isfinite(y)
        if not np.array_equal(np.isfinite(x), np.isfinite(y)):
            return float("inf")
        scale = max(float(np.abs(x[known]).max(initial=0.0)), 1e-12)
        worst = max(worst, float(np.abs(x[known] - y[known]).max(initial=0.0)) / scale)
    return worst
