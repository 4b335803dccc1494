"""What pose refinement is worth: generated trees, a second view that is off, with and without it.

The patient moved by a random vector of a given length before view 2, and its angles are off by a
given amount in a random direction; the scene says nothing of either. The error is that of the
tree's shape: Chamfer distance of the centrelines after rigid alignment, since a common motion of
the whole tree is no error of its shape. ``at its place`` is the same without alignment.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.config import RunOptions
from gcar_deploy.engine import Engine
from gcar_deploy.errors import RefusedError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.types import Points
from gcar_export.evaluate.alignment import best_rotation
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.trees import SyntheticTree, random_tree

#: (shift mm, angle deg)
SETTINGS = (
    (0.0, 0.0), (2.0, 0.0), (4.0, 0.0), (6.0, 0.0), (8.0, 0.0), (10.0, 0.0),
    (0.0, 1.0), (0.0, 2.0), (0.0, 3.0), (0.0, 5.0), (4.0, 1.0), (8.0, 3.0),
)  # fmt: skip
SEED = 60_001
#: pixels along each side of the pictures, mm at the detector
_SIDE, _PITCH_MM = 384, 0.52
_MM_PER_COUNT = 0.001


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One tree at one setting, one way of handling the pose.

    Attributes
    ----------
    tree : int, number of the generated tree
    shift_mm, angle_deg : float, what the second view is off by
    pose : ``auto`` or ``off``
    status : ``ok``, ``degraded`` or ``refused``
    chamfer_mm : after rigid alignment, None where refused
    in_place_mm : without alignment
    """

    tree: int
    shift_mm: float
    angle_deg: float
    pose: str
    status: str
    chamfer_mm: float | None
    in_place_mm: float | None


def measure(
    out: Path, trees: int, settings: Sequence[tuple[float, float]] = SETTINGS,
    progress: Callable[[str], None] | None = None,
) -> list[Row]:  # fmt: skip
    """Run what ``out`` (a file of JSON lines) does not hold yet; return all rows."""
    rows = _known(out)
    done = {(r.tree, r.shift_mm, r.angle_deg, r.pose) for r in rows}
    engines = {
        pose: Engine(threads=1, options=_options(pose == "auto")) for pose in ("auto", "off")
    }
    for number in range(trees):
        for shift, angle in settings:
            for pose, engine in engines.items():
                if (number, shift, angle, pose) in done:
                    continue
                rows.append(one(number, shift, angle, pose, engine))
                with out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(dataclasses.asdict(rows[-1])) + "\n")
                if progress is not None:
                    progress(f"tree {number + 1}/{trees}  {shift:g} mm, {angle:g} deg, {pose}")
    return [r for r in rows if r.tree < trees]


def one(number: int, shift_mm: float, angle_deg: float, pose: str, engine: Engine) -> Row:
    """Simulate and reconstruct one tree; the same error for both ways of handling it."""
    rng = np.random.default_rng([SEED, number])
    tree = random_tree(rng).sides("left")
    told = (_view(-30, -20, 1100), _view(45, 25, 1060))
    direction, turn = rng.normal(size=3), rng.uniform(0, 2 * np.pi)
    true = told[1].turned(angle_deg * np.cos(turn), angle_deg * np.sin(turn))
    true = true.moved(shift_mm * direction / np.linalg.norm(direction))
    pictures = [_picture(k, told[k], seen, tree) for k, seen in enumerate((told[0], true))]
    grid = Grid(center_mm=(0, 0, 0), size_mm=(128,) * 3, shape=(128,) * 3)
    try:
        result = engine.reconstruct(pictures, grid)
    except RefusedError:
        return Row(
            tree=number, shift_mm=shift_mm, angle_deg=angle_deg, pose=pose, status="refused",
            chamfer_mm=None, in_place_mm=None,
        )  # fmt: skip
    truth = np.concatenate([vessel.points_mm for vessel in tree.vessels])
    found = np.concatenate([branch.points_mm for branch in result.tree.branches])
    return Row(
        tree=number, shift_mm=shift_mm, angle_deg=angle_deg, pose=pose, status=result.status,
        chamfer_mm=chamfer_mm(aligned(found, truth), truth),
        in_place_mm=chamfer_mm(found, truth),
    )  # fmt: skip


def chamfer_mm(a: Points, b: Points) -> float:
    """Mean of both mean distances to the nearest point of the other, mm."""
    return float(0.5 * (cKDTree(b).query(a)[0].mean() + cKDTree(a).query(b)[0].mean()))


def aligned(moving: Points, fixed: Points, steps: int = 60) -> Points:
    """Rigidly lay ``moving`` on ``fixed``, from where it is: a fixed share of pairs is trusted."""
    tree, at = cKDTree(fixed), moving
    for _ in range(steps):
        gap, index = tree.query(at)
        near = gap <= np.quantile(gap, 0.9)
        R, shift = best_rotation(at[near], fixed[index[near]])
        at = at @ R.T + shift
    return at


def markdown(rows: Sequence[Row]) -> str:
    """Mean Chamfer distances per setting, with the statuses."""
    out = [
        "| shift mm | angle deg | trees | off: Chamfer mm | auto: Chamfer mm | off: at its place | "
        "auto: at its place | off: ok/degraded/refused | auto: ok/degraded/refused |",
        "|---" * 9 + "|",
    ]
    for shift, angle in sorted({(r.shift_mm, r.angle_deg) for r in rows}):
        part = {
            pose: [r for r in rows if (r.shift_mm, r.angle_deg, r.pose) == (shift, angle, pose)]
            for pose in ("off", "auto")
        }
        cells = [f"{shift:g}", f"{angle:g}", str(len(part["auto"]))]
        for key in ("chamfer_mm", "in_place_mm"):
            cells += [_mean([getattr(r, key) for r in part[pose]]) for pose in ("off", "auto")]
        for pose in ("off", "auto"):
            counts = [sum(r.status == s for r in part[pose]) for s in ("ok", "degraded", "refused")]
            cells.append("/".join(map(str, counts)))
        out.append("| " + " | ".join(cells) + " |")
    return "\n".join(out)


def _mean(values: Sequence[float | None]) -> str:
    known = [v for v in values if v is not None]
    if not known:
        return "-"
    short = "" if len(known) == len(values) else f" (n={len(known)})"
    return f"{np.mean(known):.2f} ± {np.std(known):.2f}{short}"


def _options(pose: bool) -> RunOptions:
    options = RunOptions()
    return dataclasses.replace(options, pose=dataclasses.replace(options.pose, enabled=pose))


def _view(primary: float, secondary: float, sdd: float) -> CArm:
    return CArm(
        primary_angle_deg=primary, secondary_angle_deg=secondary, sod_mm=765, sdd_mm=sdd,
        rows=_SIDE, columns=_SIDE, pixel_spacing_mm=(_PITCH_MM, _PITCH_MM),
    )  # fmt: skip


def _picture(number: int, told: CArm, seen: CArm, tree: SyntheticTree) -> Angiogram:
    counts = np.rint(path_lengths(seen, *tree.segments()) / _MM_PER_COUNT).astype(np.float32)
    return Angiogram(
        view_id=str(number + 1), carm=told, pixels=counts, bit_depth=16,
        intensity=Intensity(kind="path_length", polarity="bright", mm_per_count=_MM_PER_COUNT),
        sha256=hashlib.sha256(counts.tobytes()).hexdigest(),
    )  # fmt: skip


def _known(out: Path) -> list[Row]:
    if not out.is_file():
        return []
    return [Row(**json.loads(line)) for line in out.read_text(encoding="utf-8").splitlines()]
