"""How probable it is that a stretch of a tree is a ghost.

A logistic model of the figures in ``ghost_figures``. Its coefficients are in ``ghosts.json``,
fitted on generated trees by ``gcar-export ghost-fit``, which also draws how the stated
probabilities compare with the shares that come true.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from importlib import resources

import numpy as np
from scipy.special import expit

from gcar_deploy.config import QualityOptions
from gcar_deploy.quality.ghost_figures import FIGURES, Stretches, ghost_figures, stretches_of
from gcar_deploy.quality.shown import Shown
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Scalars

#: a point further than this from every vessel is a ghost's, mm
GHOST_MM = 2.0
#: figures count up to so many standard deviations from the usual: beyond, the fit knows nothing
MOST_SD = 3.0
#: from this probability on a stretch is called a probable ghost, and drawn dashed
PROBABLE = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class GhostModel:
    """Logistic model of a stretch's figures.

    Attributes
    ----------
    mean, sd, weight : one a figure, in the order of ``FIGURES``
    bias : log odds of a stretch with usual figures
    """

    mean: Scalars
    sd: Scalars
    weight: Scalars
    bias: float

    def standardised(self, figures: Array) -> Array:
        """(k, figures) in standard deviations from the usual, held to ``MOST_SD``."""
        out: Array = np.clip((figures - self.mean) / self.sd, -MOST_SD, MOST_SD)
        return out

    def probability(self, figures: Array) -> Scalars:
        """(k,) of (k, figures)."""
        out: Scalars = expit(self.standardised(figures) @ self.weight + self.bias)
        return out


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProbableGhost:
    """Neighbouring stretches of one branch that are probable ghosts.

    Attributes
    ----------
    branch : number of the branch, from 0
    start_mm, end_mm : where along it
    probability : mean over its length
    """

    branch: int
    start_mm: float
    end_mm: float
    probability: float


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Ghosts:
    """What is known of ghosts in a tree.

    Attributes
    ----------
    points : per branch (m,) probability that the vessel is not where the point is
    branches : (b,) mean over each branch's length
    share : mean over the tree: the share of its length that is to be expected in ghosts
    probable : stretches that are probable ghosts
    stretches : Stretches
    figures : (k, figures) what the probabilities rest on
    """

    points: tuple[Scalars, ...]
    branches: Scalars
    share: float
    probable: tuple[ProbableGhost, ...]
    stretches: Stretches
    figures: Array


def find_ghosts(shown: Shown) -> Ghosts | None:
    """State the probability of a ghost along a tree.

    Parameters
    ----------
    shown : the tree, its evidence with the C-arms and in the order of its views

    Returns
    -------
    Ghosts; None without evidence or a branch, and of three and more views, which the model does
    not know
    """
    tree, evidence = shown.tree, shown.evidence
    if evidence is None or not tree.branches or len(shown.views) != 2:
        return None
    stretches = stretches_of(tree)
    figures = ghost_figures(shown, evidence, stretches)
    told = shipped_model().probability(figures)
    along = np.split(told[stretches.point], np.cumsum([len(b) for b in tree.branches])[:-1])
    weight = stretches.length_mm
    whole = np.bincount(stretches.branch, weight)
    per_branch: Scalars = np.bincount(stretches.branch, told * weight) / whole
    return Ghosts(
        points=tuple(along),
        branches=per_branch,
        share=float(np.average(told, weights=weight)),
        probable=_probable(tree, stretches, told),
        stretches=stretches,
        figures=figures,
    )


def ghost_share(figures: Array, length_mm: Scalars) -> float:
    """Share of a tree's length that is to be expected in ghosts, by the figures of its stretches.

    Parameters
    ----------
    figures : (k, figures), by the names of ``ghost_figures.FIGURES``
    length_mm : (k,)
    """
    return float(np.average(shipped_model().probability(figures), weights=length_mm))


def check_ghosts(ghosts: Ghosts | None, options: QualityOptions) -> list[str]:
    """Judge whether another tree would explain the pictures nearly as well; as ``degraded``."""
    if ghosts is None or ghosts.share <= options.good_ghost_share:
        return []
    worst = sorted(ghosts.probable, key=lambda g: g.start_mm - g.end_mm)[:3]
    named = ", ".join(f"{g.branch + 1} ({g.end_mm - g.start_mm:.0f} mm)" for g in worst)
    where = f", most likely in branch {named}" if named else ""
    return [
        f"another tree explains the pictures nearly as well: {ghosts.share:.0%} of this one's "
        f"length is expected to lie elsewhere (at most {options.good_ghost_share:.0%} is "
        f"usual){where}"
    ]


def _probable(tree: Tree, stretches: Stretches, told: Scalars) -> tuple[ProbableGhost, ...]:
    out = []
    for number, branch in enumerate(tree.branches):
        own = told[stretches.branch == number]
        step = branch.length_mm / len(own)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], own >= PROBABLE, [0]])))
        for first, stop in edges.reshape(-1, 2).tolist():
            out.append(
                ProbableGhost(
                    branch=number,
                    start_mm=first * step,
                    end_mm=stop * step,
                    probability=float(own[first:stop].mean()),
                )
            )
    return tuple(out)


@functools.cache
def shipped_model() -> GhostModel:
    """Return the model that lies beside this file."""
    text = resources.files("gcar_deploy.quality").joinpath("ghosts.json").read_text("utf-8")
    held = json.loads(text)
    by_name = {figure["name"]: figure for figure in held["figures"]}
    columns = {
        key: np.array([by_name[name][key] for name in FIGURES]) for key in ("mean", "sd", "weight")
    }
    return GhostModel(columns["mean"], columns["sd"], columns["weight"], float(held["bias"]))
