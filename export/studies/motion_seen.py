"""How often motion shows in masks and raw pictures: ``python -m gcar_export.studies.motion_seen``.

Generated trees, left and right, in two views that stand anywhere C-arms do, with pixels of 0.3 to
0.8 mm (masks) or 0.3 to 0.45 mm (raw); before the second one the heart deforms smoothly
(``scenes/motion``), and every third patient is shifted. No tree is made: what the pose says of the
motion is held against how far the rays of true points pass each other (gap), which is what two
views can see of it.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from typing import TypeAlias

import numpy as np

from gcar_deploy.config import RunOptions
from gcar_deploy.errors import RefusedError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import ray_gaps
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.imaging.net import Segmenter, load_segmenter
from gcar_deploy.pose.agreement import agreeing, with_motion
from gcar_deploy.pose.pairwise import Pose
from gcar_deploy.tree.curves import resample
from gcar_deploy.types import Points
from gcar_export.scenes.gantry import Field, clinical_views, focused
from gcar_export.scenes.motion import heart_motion, moved_tree
from gcar_export.scenes.trees import SIDES, random_tree, rough_style
from gcar_export.studies.command import ended
from gcar_export.studies.motion_table import picture_of_tree

SEED, LEVELS_MM = 91_002, (0.0, 1.0, 2.0, 3.0, 4.0, 6.0)
PIXELS_MM = {"mask": (0.3, 0.8), "raw": (0.3, 0.45)}
#: standard deviation of a patient's shift along each axis, mm; smaller gaps are no matter, mm
SHIFT_MM, SMALL_MM = 2.0, 0.6
#: what the pictures show
FIELD = Field(middle_mm=np.zeros(3), radius_mm=75.0)
#: motion, told, undone, placed, gap by the rigid pose and by the one that is used
Row: TypeAlias = tuple[float, bool, bool, bool, float, float]


def seen(kind: str, trees: int, levels: Sequence[float] = LEVELS_MM) -> Iterator[Row]:
    """Yield what becomes of each pair."""
    wanted = RunOptions().imaging.segmenter
    segmenter = load_segmenter(wanted, 1) if kind == "raw" else None
    for number in range(trees):
        for level in levels:
            with contextlib.suppress(RefusedError):  # no vessel found
                yield judged(kind, number, level, segmenter)


def judged(kind: str, number: int, level: float, segmenter: Segmenter | None = None) -> Row:
    """Return what becomes of one pair; the same tree and views at every level."""
    options = RunOptions()
    rng = np.random.default_rng([SEED, number])
    tree = random_tree(rng, (None, rough_style(rng))[number // 2 % 2]).sides(SIDES[number % 2])
    views = clinical_views(rng, 2, float(rng.uniform(*PIXELS_MM[kind])))
    carms = [focused(carm, FIELD) for carm in views]
    every = np.concatenate([resample(v.points_mm, 1.0) for v in tree.vessels])
    motion = heart_motion(rng, every, level)
    shift = SHIFT_MM * rng.normal(size=3) * (number % 3 == 0)
    moved = moved_tree(tree, motion, np.eye(3))
    vessels = tuple(dataclasses.replace(v, points_mm=v.points_mm + shift) for v in moved.vessels)
    trees = tree, dataclasses.replace(moved, vessels=vessels)
    pictures = [
        picture_of_tree(k, carm, own, kind, rng)
        for k, (carm, own) in enumerate(zip(carms, trees, strict=True))
    ]
    found = [extract_vessels(p, options.imaging, segmenter) for p in pictures]
    kept, rigid, _ = agreeing(pictures, found, options)
    pose = with_motion(kept, rigid, options)[1]
    lines = [np.concatenate([v.points_mm for v in own.vessels]) for own in trees]
    undone, told = pose.motion is not None, pose.motion_mm > 0
    placed = not told and bool((pose.theta != rigid[1].theta).any())
    return level, told, undone, placed, _gap(carms, lines, rigid[1]), _gap(carms, lines, pose)


def _gap(carms: Sequence[CArm], lines: Sequence[Points], pose: Pose) -> float:
    """Root mean square distance between the rays of the same points, mm."""
    first, second = (carm.project(line)[0] for carm, line in zip(carms, lines, strict=True))
    if pose.motion is not None:
        second = second + pose.motion.at(carms[1], second)
    return float(np.sqrt(np.mean(ray_gaps(carms[0], pose.applied(carms[1]), first, second) ** 2)))


def table(rows: Sequence[Row]) -> str:
    """Markdown: a row per level."""
    out = [
        f"| motion mm | pairs | told | gap over {SMALL_MM:g} mm | of them told | undone | gap mm "
        "| after mm | placed | gap mm | after mm |",
        "|---" * 11 + "|",
    ]
    for level in sorted({row[0] for row in rows}):
        own = np.array([row for row in rows if row[0] == level], dtype=np.float64)
        told, undone, placed, large = (
            own[:, 1] > 0, own[:, 2] > 0, own[:, 3] > 0, own[:, 4] > SMALL_MM
        )  # fmt: skip
        cells = [f"{level:g}", len(own), told.sum(), large.sum(), (told & large).sum()]
        for part in (undone, placed):
            means = own[part, 4:].mean(axis=0) if part.any() else None
            cells += [part.sum(), *("--" if means is None else (f"{m:.2f}" for m in means))]
        out.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(out)


def main() -> None:
    """Print the table of one kind of pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kind", choices=tuple(PIXELS_MM), default="mask")
    parser.add_argument("--trees", type=int, default=20)
    parser.add_argument("--levels", nargs="+", type=float, default=list(LEVELS_MM))
    asked = parser.parse_args()
    print(table(list(seen(asked.kind, asked.trees, asked.levels))))


if __name__ == "__main__":
    raise SystemExit(ended(main))
