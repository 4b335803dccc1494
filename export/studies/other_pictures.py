"""Trees from pictures as other simulators draw them.

    python -m gcar_export.studies.other_pictures

Two clinical views of generated trees, left and right, as 8-bit pictures of several looks; the
geometry says ``raw`` and nothing of the polarity. A point is found where the other line passes
within ``NEAR_MM``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator

import numpy as np

from gcar_deploy.engine import Engine
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.types import Array
from gcar_export.scenes.protocols import MM_PER_COUNT, clinical_geometry
from gcar_export.studies.command import ended, print_table
from gcar_export.studies.pair_rows import judge
from gcar_export.studies.wrong_scenes import Exam, exam

SEED = 31_007
NEAR_MM = 1.5
#: how path lengths become a picture; see ``LOOKS``
Look = Callable[[Array, Array, Array, np.random.Generator], Array]


def _left(path: Array, per_mm: float = 0.3) -> Array:
    return np.exp(-per_mm * path)


def _shuttered(grey: Array, v: Array, u: Array) -> Array:
    """Leave a round field that touches the border."""
    return np.where(np.hypot(u - 0.5, v - 0.5) < 0.5, grey, 5.0)


def _ribs(v: Array, u: Array) -> Array:
    """Absorbance of three ribs that run across the picture, their width a 24th of it."""
    places = (0.2 + 0.2 * u, 0.75 - 0.25 * u, 0.9 - 0.3 * u * u)
    out: Array = np.sum([0.15 * np.exp(-(((v - one) / 0.025) ** 2)) for one in places], axis=0)
    return out


def _cloud(v: Array, u: Array) -> Array:
    """Absorbance of a dark cloud near a corner."""
    return 2.2 * np.exp(-((u - 0.72) ** 2 + (v - 0.25) ** 2) / (2 * 0.13**2))


#: grey values 0 .. 255 from path in mm, row and column as shares of the side, and a source of noise
LOOKS: dict[str, Look] = {
    "dark on white": lambda path, v, u, rng: 250 * _left(path),
    "flat areas": lambda path, v, u, rng: np.where(path > MM_PER_COUNT, 25.0, 250.0),
    "bright on black": lambda path, v, u, rng: 250 - 240 * _left(path),
    "faint": lambda path, v, u, rng: 200 * _left(path, 0.05) + rng.normal(0, 2, path.shape),
    "light from one side": lambda path, v, u, rng: 230 * (0.55 + 0.45 * u) * _left(path),
    "vignette, grain": lambda path, v, u, rng: (
        240 * np.exp(-1.2 * ((u - 0.5) ** 2 + (v - 0.45) ** 2)) * _left(path)
        + rng.normal(0, 3, path.shape)
    ),
    "coarse grain": lambda path, v, u, rng: 200 * _left(path) + rng.normal(0, 8, path.shape),
    "black vessels": lambda path, v, u, rng: 400 * _left(path, 0.6) - 60,
    "round shutter": lambda path, v, u, rng: _shuttered(
        (150 + 80 * u) * _left(path) + rng.normal(0, 3, path.shape), v, u
    ),
    "negative, round shutter": lambda path, v, u, rng: (
        255 - _shuttered((150 + 80 * u) * _left(path) + rng.normal(0, 3, path.shape), v, u)
    ),
    "ribs": lambda path, v, u, rng: (
        220 * np.exp(-_ribs(v, u)) * _left(path) + rng.normal(0, 2, path.shape)
    ),
    "noise on a dark cloud": lambda path, v, u, rng: (
        230 * np.exp(-_cloud(v, u)) * _left(path) + rng.normal(0, 4, path.shape)
    ),
}


def pictures(case: Exam, look: Look, number: int) -> list[Angiogram]:
    """Return both pictures of an examination in another look."""
    out = []
    for k, (carm, counts) in enumerate(zip(case.told.carms, case.told.images, strict=True)):
        rng = np.random.default_rng([SEED, number, k])
        v, u = np.indices(counts.shape) / counts.shape[0]
        grey = np.rint(np.clip(look(counts * MM_PER_COUNT, v, u, rng), 0, 255))
        out.append(
            Angiogram(
                view_id=str(k + 1), carm=carm, pixels=grey.astype(np.float32), bit_depth=8,
                intensity=Intensity(kind="raw"), sha256=f"{number}-{k}",
            )
        )  # fmt: skip
    return out


def judged(pairs: int) -> Iterator[tuple[str, float, float, str]]:
    """Yield look, share of the true line found, share of ours that is true, and status."""
    engine, grid = Engine(), clinical_geometry(2)[2]
    for number in range(pairs):
        case = exam(SEED, number, "path_length", 2)
        for name, look in LOOKS.items():
            views = pictures(case, look, number)
            yield name, *judge(engine, views, grid, case.line_mm, NEAR_MM)


def table(rows: list[tuple[str, float, float, str]]) -> str:
    """Markdown: one line per look."""
    out = [
        f"| picture | pairs | true line found within {NEAR_MM:g} mm % | ours that is true % "
        "| the worse of both, worst pair % | ok / degraded / refused |",
        "|---" * 6 + "|",
    ]
    for name in LOOKS:
        own = [row for row in rows if row[0] == name]
        shares = 100 * np.array([row[1:3] for row in own])
        states = [row[3] for row in own]
        counts = " / ".join(str(states.count(s)) for s in ("ok", "degraded", "refused"))
        out.append(
            f"| {name} | {len(own)} | {shares[:, 0].mean():.1f} | {shares[:, 1].mean():.1f} | "
            f"{shares.min():.1f} | {counts} |"
        )
    return "\n".join(out)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=10)
    pairs = parser.parse_args().pairs
    print_table(judged(pairs), pairs * len(LOOKS), table)


if __name__ == "__main__":
    raise SystemExit(ended(main))
