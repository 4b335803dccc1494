"""What smooth motion between the runs costs: ``python -m gcar_export.studies.motion_table``.

Generated trees, left and right, in two views; before the second one the heart deforms smoothly,
by 0 .. 6 mm (root mean square, its mean taken out). Arms:

======= =======================================================================================
rigid   shifts and turns alone are estimated
auto    as shipped
across  oracle: the part of the motion that two views see, across their epipolar planes, undone
======= =======================================================================================

What lies within the epipolar planes moves the tree and leaves no trace, so a found tree is held
against the one that a perfect matcher would find: the rays of each true point, triangulated.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.config import RunOptions
from gcar_deploy.engine import Engine
from gcar_deploy.errors import RefusedError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import plane_normal, triangulate
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.measure.metrics import best_shifted_dice
from gcar_deploy.pose import registration
from gcar_deploy.tree.curves import points_every, resample
from gcar_deploy.types import Points
from gcar_export.scenes.motion import heart_motion, moved_tree
from gcar_export.scenes.protocols import MM_PER_COUNT, case_geometry
from gcar_export.scenes.render import occupancy, path_lengths
from gcar_export.scenes.trees import SIDES, SyntheticTree, random_tree, rough_style
from gcar_export.studies.command import ended
from gcar_export.studies.pose_table import aligned, chamfer_mm
from gcar_export.studies.wrong_scenes import SPREAD_DEG, picture_of

SEED = 91_001
LEVELS_MM = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0)
ARMS = ("rigid", "auto", "across")
#: set-up and kind of picture
PROTOCOLS = ("paper", "clinical", "mask", "raw")
#: a point further than this from the other centreline is wrong, or missed, mm
WRONG_MM = 3.0
#: an ``ok`` tree whose shape is further off is a wrong one, mm
BAD_MM = 1.5


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One tree at one level, one arm.

    Attributes
    ----------
    protocol, arm, tree, level_mm : what was asked
    status, findings : what came out
    motion_mm : what was reported of the second view's motion, per view
    shape_mm : Chamfer distance from the triangulated true tree, after rigid alignment
    first_mm, mean_mm : the same from the tree of view 1, and from the mean of both views' trees
    wrong, missed : share of found points far from the triangulated tree, and the reverse
    dsc : of occupancy at 0.5 with the tree of view 1, of view 2 or halfway, whichever is met
        best: any phase of the heart is right; best common shift
    """

    protocol: str
    arm: str
    tree: int
    level_mm: float
    status: str
    findings: tuple[str, ...] = ()
    motion_mm: tuple[float, ...] = ()
    shape_mm: float | None = None
    first_mm: float | None = None
    mean_mm: float | None = None
    wrong: float | None = None
    missed: float | None = None
    dsc: float | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Pair:
    """Two pictures of a heart that moved between them, and the true trees."""

    pictures: tuple[Angiogram, Angiogram]
    carms: tuple[CArm, CArm]
    grid: Grid
    trees: tuple[SyntheticTree, SyntheticTree]

    @property
    def lines(self) -> tuple[Points, Points]:
        """(n, 3) points of both centrelines, mm, in step."""
        one, two = (np.concatenate([v.points_mm for v in tree.vessels]) for tree in self.trees)
        return one[::2], two[::2]


def make_pair(protocol: str, number: int, level_mm: float, arm: str) -> Pair:
    """Simulate one pair; the same tree, views and direction of motion at every level and arm."""
    rng = np.random.default_rng([SEED, number, PROTOCOLS.index(protocol)])
    tree = random_tree(rng, (None, rough_style(rng))[number // 2 % 2]).sides(SIDES[number % 2])
    carms, grid = case_geometry("paper" if protocol == "paper" else "clinical", 2)
    if protocol != "paper":
        carms = [carm.turned(*(SPREAD_DEG * rng.normal(size=2))) for carm in carms]
    every = np.concatenate([resample(v.points_mm, 1.0) for v in tree.vessels])
    motion = heart_motion(rng, every, level_mm)
    normal = plane_normal(*carms)
    kept = np.eye(3) - (np.outer(normal, normal) if arm == "across" else 0.0)
    trees = tree, moved_tree(tree, motion, kept)
    kind = "path_length" if protocol in ("paper", "clinical") else protocol
    pictures = tuple(
        picture_of_tree(k, carm, own, kind, rng)
        for k, (carm, own) in enumerate(zip(carms, trees, strict=True))
    )
    return Pair(pictures, (carms[0], carms[1]), grid, trees)  # type: ignore[arg-type]


def one(protocol: str, number: int, level_mm: float, arm: str, engine: Engine) -> Row:
    """Simulate and reconstruct one pair."""
    pair = make_pair(protocol, number, level_mm, arm)
    first, second = pair.lines
    row = Row(protocol=protocol, arm=arm, tree=number, level_mm=level_mm, status="refused")
    try:
        with _without_motion() if arm == "rigid" else contextlib.nullcontext():
            result = engine.reconstruct(list(pair.pictures), pair.grid)
    except RefusedError as error:
        return dataclasses.replace(row, findings=(str(error),))
    rays = [c.project(p)[0] for c, p in zip(pair.carms, (first, second), strict=True)]
    best, _ = triangulate(pair.carms, rays)
    found = points_every(result.tree, 1.0)
    laid = aligned(found, best)
    phases = (*pair.trees, moved_halfway(*pair.trees))
    return dataclasses.replace(
        row, status=result.status, findings=result.quality.findings,
        motion_mm=tuple(float(p.motion_mm) for p in result.poses),
        shape_mm=chamfer_mm(laid, best),
        first_mm=chamfer_mm(aligned(found, first), first),
        mean_mm=chamfer_mm(aligned(found, 0.5 * (first + second)), 0.5 * (first + second)),
        wrong=float((cKDTree(best).query(laid)[0] > WRONG_MM).mean()),
        missed=float((cKDTree(laid).query(best)[0] > WRONG_MM).mean()),
        dsc=max(
            best_shifted_dice(_occupied(tree, pair.grid), result.volume).value or 0.0
            for tree in phases
        ),
    )  # fmt: skip


@contextlib.contextmanager
def _without_motion() -> Iterator[None]:
    """Leave the stage out: there is no option for it, since nobody should want to."""
    shipped = registration.with_motion
    registration.with_motion = lambda views, poses, options: tuple(poses)
    try:
        yield
    finally:
        registration.with_motion = shipped


def moved_halfway(one: SyntheticTree, two: SyntheticTree) -> SyntheticTree:
    """Return the tree halfway between two positions of the same one."""
    return dataclasses.replace(
        one,
        vessels=tuple(
            dataclasses.replace(a, points_mm=0.5 * (a.points_mm + b.points_mm))
            for a, b in zip(one.vessels, two.vessels, strict=True)
        ),
    )


def _occupied(tree: SyntheticTree, grid: Grid) -> np.ndarray:
    index = np.indices(grid.shape).reshape(3, -1).T
    voxel = float(grid.spacing_mm[0])
    starts, ends, radii = tree.segments()
    low = np.minimum(starts, ends).min(axis=0) - 4
    high = np.maximum(starts, ends).max(axis=0) + 4
    points = grid.index2world(index)
    near = ((points > low) & (points < high)).all(axis=1)
    out = np.zeros(len(points))
    out[near] = occupancy(points[near], voxel, starts, ends, radii, sub=2)[0]
    return out.reshape(grid.shape)


def picture_of_tree(
    number: int, carm: CArm, tree: SyntheticTree, kind: str, rng: np.random.Generator
) -> Angiogram:
    """Make a picture of a tree; ``kind`` as of ``Intensity``."""
    pixels = picture_of(path_lengths(carm, *tree.segments()), kind, rng)
    exact = kind == "path_length"
    return Angiogram(
        view_id=str(number + 1), carm=carm, pixels=pixels.astype(np.float32),
        bit_depth=16 if exact else 8,
        intensity=Intensity(
            kind=kind, polarity="dark" if kind == "raw" else "bright",
            mm_per_count=MM_PER_COUNT if exact else None,
        ),
        sha256=hashlib.sha256(pixels.tobytes()).hexdigest(),
    )  # fmt: skip


def measure(
    out: Path, trees: Sequence[int], protocols: Sequence[str] = PROTOCOLS,
    levels: Sequence[float] = LEVELS_MM, arms: Sequence[str] = ARMS,
    progress: Callable[[str], None] | None = None,
) -> list[Row]:  # fmt: skip
    """Run what ``out`` (a file of JSON lines) does not hold yet; return all rows."""
    rows = list(_known(out))
    done = {(r.protocol, r.arm, r.tree, r.level_mm) for r in rows}
    engine = Engine(threads=1, options=RunOptions())
    for number in trees:
        for protocol in protocols:
            for level in levels:
                for arm in arms:
                    if (protocol, arm, number, level) in done or (not level and arm != "auto"):
                        continue
                    rows.append(one(protocol, number, level, arm, engine))
                    with out.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(dataclasses.asdict(rows[-1])) + "\n")
                    if progress is not None:
                        progress(f"{protocol} tree {number} {level:g} mm {arm}: {rows[-1].status}")
    return rows


def _known(out: Path) -> Iterator[Row]:
    if out.is_file():
        for line in out.read_text(encoding="utf-8").splitlines():
            yield Row(**json.loads(line))


def table(rows: Sequence[Row]) -> str:
    """Markdown: a row per protocol, level and arm."""
    out = [
        "| pictures | motion mm | arm | pairs | DSC % | shape mm | of view 1 | of the mean | "
        "wrong % | missed % | told | reported mm | ok / degraded / refused | ok and off |",
        "|---" * 14 + "|",
    ]
    keys = sorted({(PROTOCOLS.index(r.protocol), r.level_mm, ARMS.index(r.arm)) for r in rows})
    for protocol, level, arm in keys:
        own = [
            r for r in rows
            if (r.protocol, r.level_mm, r.arm) == (PROTOCOLS[protocol], level, ARMS[arm])
        ]  # fmt: skip
        counts = [sum(r.status == s for r in own) for s in ("ok", "degraded", "refused")]
        off = sum(r.status == "ok" and (r.mean_mm or 0.0) > BAD_MM for r in own)
        cells = [
            PROTOCOLS[protocol], f"{level:g}", ARMS[arm], str(len(own)),
            _mean([r.dsc for r in own], 100, 1), *(_mean([getattr(r, key) for r in own], 1, 2)
            for key in ("shape_mm", "first_mm", "mean_mm")),
            *(_mean([getattr(r, key) for r in own], 100, 1) for key in ("wrong", "missed")),
            str(sum(any(r.motion_mm) for r in own)),
            _mean([max(r.motion_mm, default=0.0) for r in own if any(r.motion_mm)], 1, 2),
            " / ".join(map(str, counts)), str(off),
        ]  # fmt: skip
        out.append("| " + " | ".join(cells) + " |")
    return "\n".join(out)


def _mean(values: Sequence[float | None], scale: float, digits: int) -> str:
    known = [scale * v for v in values if v is not None]
    return f"{np.mean(known):.{digits}f}" if known else "-"


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("motion.jsonl"))
    parser.add_argument("--trees", type=int, default=12)
    parser.add_argument("--protocols", nargs="+", choices=PROTOCOLS, default=list(PROTOCOLS))
    parser.add_argument("--levels", nargs="+", type=float, default=list(LEVELS_MM))
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS))
    asked = parser.parse_args()
    rows = measure(
        asked.out, range(asked.trees), asked.protocols, asked.levels, asked.arms,
        progress=lambda line: print(line, flush=True),
    )  # fmt: skip
    print(table(rows))


if __name__ == "__main__":
    raise SystemExit(ended(main))
