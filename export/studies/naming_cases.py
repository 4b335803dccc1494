"""Trees whose vessel names are known, to fit and judge ``gcar_deploy.measure.naming`` on.

Generated trees are put on voxels and thinned as the runtime does it. Mirrored and turned ones,
and parts that lack what a name rests on, have no right reading.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.measure.naming import Reading
from gcar_deploy.tree.centerline import build_tree
from gcar_deploy.tree.edit import kept_branches
from gcar_deploy.tree.tree import Tree
from gcar_export.scenes.trees import SyntheticTree, Vessel, random_tree

NAMES = ("LM", "LAD", "LCx", "RCA")
#: voxel that trees are thinned at; a branch has a vessel's name where its points lie this near
VOXEL_MM, NEAR_MM = 1.2, 2.5
#: share of a branch's points that must lie on one vessel for it to have that name
OWN_SHARE = 0.6
#: a reading is right if so much of what it names is, and so much of each way is named, mm
RIGHT_SHARE, HALF_RIGHT_SHARE, LEAST_RIGHT_MM = 0.9, 0.6, 15.0
#: shares of generated free ends that are cut off, as a predictor misses them
LOST_SHARE = 0.1
KINDS = ("as it is", "mirrored", "turned", "part")


@dataclasses.dataclass(frozen=True, eq=False)
class NamedTree:
    """A tree, the true name of each branch (empty where it has none), and what kind it is."""

    tree: Tree
    names: tuple[str, ...]
    kind: str


def named_case(seed: int, kind: str, which: str) -> NamedTree | None:
    """Make one case; None where nothing is left of it.

    Parameters
    ----------
    seed : of the generator
    kind : one of ``KINDS``
    which : ``left``, ``right`` or ``whole``
    """
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    made = random_tree(np.random.default_rng(seed))
    made = made if which == "whole" else made.sides(which)
    vessels = _part(made, rng) if kind == "part" else made.vessels
    matrix = _matrix(kind, rng)
    vessels = tuple(dataclasses.replace(v, points_mm=v.points_mm @ matrix.T) for v in vessels)
    tree = thinned(vessels)
    lost = (rng.random(len(tree.branches)) < LOST_SHARE) & (_free_ends(tree) > 0)
    tree = kept_branches(tree, ~lost)
    if not tree.branches:
        return None
    true = branch_names(tree, vessels) if kind == "as it is" else ("",) * len(tree.branches)
    return NamedTree(tree, true, kind)


def thinned(vessels: tuple[Vessel, ...]) -> Tree:
    """Build the tree of vessels' voxels as the runtime builds it of a predictor's."""
    line = np.concatenate([v.points_mm for v in vessels])
    radius = np.concatenate([v.radius_mm for v in vessels])
    low, high = line.min(axis=0) - 4.0, line.max(axis=0) + 4.0
    axes = [np.arange(a, b, VOXEL_MM) for a, b in zip(low, high, strict=True)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    gap, at = cKDTree(line).query(cells, distance_upper_bound=float(radius.max()) + 0.1)
    inside = np.flatnonzero(np.isfinite(gap))
    inside = inside[gap[inside] <= np.maximum(radius[at[inside]], 0.8 * VOXEL_MM)]
    return build_tree(
        CenterPoints(
            points_mm=cells[inside],
            confidence=np.ones(len(inside)),
            radius_mm=np.full(len(inside), np.nan),
            spacing_mm=VOXEL_MM,
            source="hull",
        )
    )


def branch_names(tree: Tree, vessels: tuple[Vessel, ...]) -> tuple[str, ...]:
    """Give each branch the name of the vessel that most of its points lie on, or none."""
    lookup = cKDTree(np.concatenate([v.points_mm for v in vessels]))
    owner = np.repeat(np.arange(len(vessels)), [len(v.points_mm) for v in vessels])
    out = []
    for branch in tree.branches:
        gap, at = lookup.query(branch.points_mm)
        count = np.bincount(owner[at[gap <= NEAR_MM]], minlength=len(vessels))
        most = int(np.argmax(count))
        name = vessels[most].name
        sure = count[most] >= OWN_SHARE * len(branch) and name in NAMES
        out.append(name if sure else "")
    return tuple(out)


def right_reading(case: NamedTree, found: list[Reading]) -> tuple[int | None, bool]:
    """Find the reading that names most branches rightly.

    Returns
    -------
    its number, or None where none is right enough; and whether that is clear, which it is not
    where the best reading is between right and wrong
    """
    length = [branch.length_mm for branch in case.tree.branches]
    best, most, half_right = None, 0.0, False
    for k, reading in enumerate(found):
        right = {
            name: sum(length[b] for b, n in reading.names.items() if n == name == case.names[b])
            for name in set(reading.names.values())
        }
        told, good = sum(length[b] for b in reading.names), sum(right.values())
        if min(length_ for name, length_ in right.items() if name != "LM") < LEAST_RIGHT_MM:
            continue
        if good >= RIGHT_SHARE * told and good > most:
            best, most = k, good
        half_right = half_right or good >= HALF_RIGHT_SHARE * told
    return best, best is not None or not half_right


def components(tree: Tree) -> list[np.ndarray]:
    """Branch numbers of each component."""
    of_node = tree.components()
    of_branch = np.array([of_node[branch.start] for branch in tree.branches], dtype=int)
    return [np.flatnonzero(of_branch == k) for k in np.unique(of_branch)]


def _free_ends(tree: Tree) -> np.ndarray:
    degrees = tree.degrees
    return np.array([(degrees[b.start] == 1) + (degrees[b.end] == 1) for b in tree.branches])


def _part(made: SyntheticTree, rng: np.random.Generator) -> tuple[Vessel, ...]:
    """Leave out what a left tree is told by: its trunk with one of its two main vessels."""
    drop = {"LM", str(rng.choice(["LAD", "LCx"])), "RCA"}
    lost = ("D", "S") if "LAD" in drop else ("OM",)
    kept = [v for v in made.vessels if v.name not in drop and not v.name.startswith(lost)]
    return tuple(kept) or made.vessels[-1:]


def _matrix(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Mirror across a random axis, or turn by 90 degrees and more round a random one."""
    if kind == "mirrored":
        return np.diag(np.where(np.arange(3) == rng.integers(3), -1.0, 1.0))
    if kind != "turned":
        return np.eye(3)
    axis = rng.normal(size=3)
    x, y, z = axis / np.linalg.norm(axis)
    angle = rng.uniform(np.pi / 2, np.pi)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew
