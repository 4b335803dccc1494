"""Trees from raw pictures with all that a cath lab shows: catheters, leads, ribs, a moved table.

    python -m gcar_export.studies.cath_lab_pairs

Of each generated patient (``scenes.cine``) the two frames that go together best, as a raw pair.
Catheters and leads are drawn into each picture by itself, so they are no tree in space. ``devices
erased`` is an oracle: all that is no vessel is erased by hand. With ``--wait`` contrast comes so
many frames later, and one row is of pictures that know their runs before it came. What both views
shift alike leaves no trace: the found line is laid over the true one before a point within
``NEAR_MM`` is found.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError
from gcar_deploy.frames.bare import bare_before
from gcar_deploy.frames.choose import SeenRun
from gcar_deploy.frames.cine import Cine
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.tree.curves import resample
from gcar_deploy.types import Array, Points
from gcar_export.scenes.cine import CinePair, CineRun, cine_pair
from gcar_export.studies.command import arguments, ended, print_table
from gcar_export.studies.pair_rows import Judged, table_by_name

SEED, FRAMES = 7_400, 8
NEAR_MM = 2.0
#: rays that cross at least this much contrast are vessel; what is so near to one stays, pixels
SHOWN_MM, _NEAR_PX = 0.2, 4
#: a pair's cost: motion between its frames, mm, and this for contrast that is missing altogether
_FILLING_MM = 4.0
_ROUNDS, _CLOSEST, _STILL_MM = 300, 0.7, 1e-3
AS_SHOWN, ERASED, WITH_BARE = "as shown", "devices erased", "with frames before contrast"


def frames_of(pair: CinePair) -> tuple[int, int]:
    """Return a frame of each run: filled, and the heart in one phase."""
    filled = [run.path_mm.sum(axis=(1, 2)) for run in pair.runs]
    share = np.add.outer(*filled) / (filled[0].max() + filled[1].max())
    cost = pair.shape_error_mm() + _FILLING_MM * (1 - share)
    i, j = np.unravel_index(np.argmin(cost), cost.shape)
    return int(i), int(j)


def pictures(pair: CinePair, frames: tuple[int, int], what: str) -> list[Angiogram]:
    """Return the pair's two frames, ``what``: as shown, devices erased, or with bare frames."""
    out = []
    for k, (run, frame) in enumerate(zip(pair.runs, frames, strict=True)):
        angiogram = Angiogram(
            view_id=str(k + 1), carm=run.carm, pixels=run.pixels[frame].astype(np.float32),
            bit_depth=8, intensity=Intensity(kind="raw"), sha256=f"{k}",
        )  # fmt: skip
        if what == WITH_BARE:
            before = bare_before(_seen(run), frame)
            bare = tuple(run.pixels[k].astype(np.float32) for k in before)
            angiogram = dataclasses.replace(angiogram, bare=bare)
        if what == ERASED:
            vessel = (run.path_mm[frame] > SHOWN_MM).astype(np.uint8)
            disc = np.ones((2 * _NEAR_PX + 1,) * 2, np.uint8)
            angiogram = dataclasses.replace(angiogram, erased=cv2.dilate(vessel, disc) == 0)
        out.append(angiogram)
    return out


def _seen(run: CineRun) -> SeenRun:
    cine = Cine(name="", count=len(run.pixels), read=lambda k: (run.pixels[k].astype("f4"), 8, ""))
    return SeenRun(cine=cine, carm=run.carm, intensity=Intensity(kind="raw"))


def true_line(pair: CinePair, frame: int) -> Points:
    """(n, 3) mm: points of the tree's centrelines as the first run's frame shows them."""
    motion = pair.runs[0].motion
    phase, shift = motion.phases[frame], motion.shift_mm[frame]
    lines = [pair.beat.at(v.points_mm, phase) + shift for v in pair.tree.vessels]
    return np.concatenate([resample(line, 0.5) for line in lines])


def shares(found: Points, true: Points) -> tuple[float, float]:
    """Share of the true line found, and of the found one that is true, laid over each other."""
    near = cKDTree(true)
    begin = (found, found + true.mean(axis=0) - found.mean(axis=0))
    _, laid = min((_laid(one, true, near) for one in begin), key=lambda both: both[0])
    ours: Array = near.query(laid)[0] <= NEAR_MM
    theirs: Array = cKDTree(laid).query(true)[0] <= NEAR_MM
    return float(theirs.mean()), float(ours.mean())


def _laid(found: Points, true: Points, near: cKDTree) -> tuple[float, Points]:
    """Shift points onto their nearest ones until nothing moves: what is left, mm, and the points.

    The least shift that the closest of them ask for (trimmed ICP: Chetverikov et al. 2002).
    """
    laid, left = found, np.inf
    for _ in range(_ROUNDS):
        gap, index = near.query(laid)
        close = gap <= np.quantile(gap, _CLOSEST)
        step = (true[index][close] - laid[close]).mean(axis=0)
        laid, left = laid + step, float(gap[close].mean())
        if np.abs(step).max() < _STILL_MM:
            break
    return left, laid


def names(wait: int) -> tuple[str, ...]:
    """Kinds of pictures that a pair is reconstructed from."""
    return (AS_SHOWN, *([WITH_BARE] if wait else []), ERASED)


def judged(seed: int, patients: int, wait: int = 0) -> Iterator[tuple[str, *Judged]]:
    """Yield which picture, share of the true line found, share of ours that is true, status."""
    engine = Engine()
    for number in range(patients):
        pair = cine_pair(seed, number, FRAMES + wait, wait)
        frames = frames_of(pair)
        true = true_line(pair, frames[0])
        middle = 0.5 * (true.min(axis=0) + true.max(axis=0))
        grid = Grid(center_mm=tuple(middle.tolist()), size_mm=(160.0,) * 3, shape=(160,) * 3)
        for name in names(wait):
            try:
                result = engine.reconstruct(pictures(pair, frames, name), grid)
            except GcarError:
                yield name, 0.0, 0.0, "refused"
                continue
            lines = [resample(branch.points_mm, 0.5) for branch in result.tree.branches]
            yield name, *shares(np.concatenate(lines), true), result.status


def table(rows: Sequence[tuple[str, *Judged]]) -> str:
    """Markdown: one line for each kind of picture."""
    return table_by_name(rows, "pictures", NEAR_MM)


def main() -> None:
    """Print the table."""
    parser = arguments(__doc__, "--patients", 24, SEED)
    parser.add_argument("--wait", type=int, default=0)
    asked = parser.parse_args()
    found = judged(asked.seed, asked.patients, asked.wait)
    print_table(found, len(names(asked.wait)) * asked.patients, table)


if __name__ == "__main__":
    raise SystemExit(ended(main))
