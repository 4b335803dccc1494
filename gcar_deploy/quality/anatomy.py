"""Whether a tree lies in its frame as coronary arteries lie in a patient.

Turning both pictures by 180 degrees, or the signs of all angles, leaves two views in agreement and
makes a mirror image of the tree: geometry says nothing, anatomy does. The tree is measured by
figures that are odd, those that change their sign when an axis is turned round: third moments,
skew of the axes, where the thick vessels lie, which way the vessels bend (round the heart). A small
network scores them; the scores of the tree as it lies and as it would lie after such a mistake
are compared. Its weights are in ``anatomy.json``, fitted to generated trees by
``gcar_export.studies.anatomy_fit``, which prints how often right trees are doubted.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
from collections.abc import Mapping, Sequence
from importlib import resources

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.tree.curves import resample
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Scalars

#: points this far apart, mm, and how many of them a bend is measured over to each side
_STEP_MM, _BEND = 1.0, 8
#: shorter trees are parts, which may lie in any way: of right arteries that end in an occlusion,
#: about 100 mm long, a fifth was doubted
_LEAST_MM = 120.0
#: views with all secondary angles below this hardly tell a picture from its mirror image, deg
_LEVEL_DEG = 10.0
#: what a mistake does to the axes left, back and up, and the question that it is worth
MISTAKES: Mapping[str, tuple[tuple[int, int, int], str]] = {
    "turned": ((-1, -1, -1), "are all pictures turned by 180 degrees?"),
    "signs": ((1, -1, 1), "are the signs of all angles turned?"),
    "upside down": ((1, 1, -1), "are all pictures upside down?"),
    "mirrored": ((-1, -1, 1), "are all pictures mirrored?"),
}
#: mistakes that tilted views cannot tell either
TILTED = ("turned", "signs")
_XYZ = range(3)
_PAIRS = tuple(itertools.combinations(_XYZ, 2))
_TRIPLES = tuple(itertools.combinations_with_replacement(_XYZ, 3))
_BENDS = tuple(
    (*pair, k) for pair in itertools.combinations_with_replacement(_XYZ, 2) for k in _XYZ
)


@dataclasses.dataclass(frozen=True, eq=False)
class Usual:
    """What is usual: the network, and the line above which a tree is doubted.

    Attributes
    ----------
    scale : (k,) root mean square of the figures
    hidden : (h, k + 1) weights and, last, offsets
    out : (h,) weights
    lines : by so much a tree must score higher once that mistake is undone
    """

    scale: Scalars
    hidden: Array
    out: Scalars
    lines: Mapping[str, float]

    def score(self, figures: Array) -> Scalars:
        """(n,) how coronary-like (n, k) figures are."""
        found: Scalars = (
            np.tanh(figures / self.scale @ self.hidden[:, :-1].T + self.hidden[:, -1]) @ self.out
        )
        return found


def check_anatomy(tree: Tree, carms: Sequence[CArm]) -> list[str]:
    """Return the question that a tree is worth that lies as if all pictures were turned."""
    odds = mistake_odds(tree, carms)
    if not odds:
        return []
    above = {name: value - usual().lines[name] for name, value in odds.items()}
    likeliest = max(above, key=lambda name: above[name])
    if above[likeliest] <= 0:
        return []
    return [f"the tree does not lie as coronary arteries do: {MISTAKES[likeliest][1]}"]


def mistake_odds(tree: Tree, carms: Sequence[CArm]) -> dict[str, float]:
    """Score of the tree after undoing each mistake that these views cannot tell, less its own.

    Empty for trees too short to say.
    """
    figures = odd_figures(tree)
    if figures is None:
        return {}
    level = all(abs(carm.secondary_angle_deg) < _LEVEL_DEG for carm in carms)
    names = list(MISTAKES if level else TILTED)
    signs = np.stack([odd_signs((1, 1, 1)), *(odd_signs(MISTAKES[name][0]) for name in names)])
    scores = usual().score(signs * figures)
    return dict(zip(names, (scores[1:] - scores[0]).tolist(), strict=True))


@functools.cache
def usual() -> Usual:
    """Read what the package holds."""
    text = resources.files("gcar_deploy.quality").joinpath("anatomy.json").read_text("utf-8")
    held = json.loads(text)
    return Usual(
        np.array(held["scale"]), np.array(held["hidden"]), np.array(held["out"]), held["lines"]
    )


def odd_figures(tree: Tree) -> Scalars | None:
    """(k,) figures of a tree that change their sign with the axes; None for a short one.

    Third moments (10), products of axes (3), the thick vessels' place (3), the bend (3), the
    thickest tenth's place (3), products weighted by section (3), the bend by place (18): of points
    1 mm apart, lengths over the tree's root mean square size.
    """
    if tree.length_mm < _LEAST_MM:
        return None
    lines = [resample(branch.points_mm, _STEP_MM) for branch in tree.branches]
    radius = np.concatenate([
        np.interp(np.linspace(0, branch.length_mm, len(line)), branch.arc_mm, branch.radius_mm)
        for branch, line in zip(tree.branches, lines, strict=True)
    ])  # fmt: skip
    points = np.concatenate(lines)
    middle = points.mean(axis=0)
    size = float(np.sqrt(np.sum((points - middle) ** 2, axis=1).mean()))
    at = (points - middle) / size
    share = radius**2 / np.sum(radius**2)
    thick = share @ at
    about = at - thick
    where, bend = _bends(lines, middle, size)
    return np.array([
        *(np.mean(at[:, i] * at[:, j] * at[:, k]) for i, j, k in _TRIPLES),
        *(np.mean(at[:, i] * at[:, j]) for i, j in _PAIRS),
        *thick,
        *bend.mean(axis=0),
        *at[radius >= np.quantile(radius, 0.9)].mean(axis=0),
        *(share @ (about[:, i] * about[:, j]) for i, j in _PAIRS),
        *(np.mean(where[:, i] * where[:, j] * bend[:, k]) for i, j, k in _BENDS),
    ])  # fmt: skip


def odd_signs(axes: Sequence[int]) -> Scalars:
    """(k,) +1 or -1: what the figures are multiplied with when axes are turned round."""
    pairs = [axes[i] * axes[j] for i, j in _PAIRS]
    return np.array([
        *(axes[i] * axes[j] * axes[k] for i, j, k in _TRIPLES), *pairs, *axes, *axes, *axes,
        *pairs, *(axes[i] * axes[j] * axes[k] for i, j, k in _BENDS),
    ], dtype=np.float64)  # fmt: skip


def _bends(lines: Sequence[Array], middle: Array, size: float) -> tuple[Array, Array]:
    """Places and second differences (towards the inside of the bend) along long enough lines."""
    long = [line for line in lines if len(line) > 2 * _BEND]
    if not long:
        return np.zeros((1, 3)), np.zeros((1, 3))
    bend = [line[2 * _BEND :] - 2 * line[_BEND:-_BEND] + line[: -2 * _BEND] for line in long]
    place = [(line[_BEND:-_BEND] - middle) / size for line in long]
    return np.concatenate(place), np.concatenate(bend) / _BEND
