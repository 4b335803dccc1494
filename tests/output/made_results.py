"""Results that a small reconstruction does not give by itself."""

from __future__ import annotations

import dataclasses

import numpy as np

from gcar_deploy.quality.ghosts import Ghosts, ProbableGhost


def with_tree(result, tree):
    """Another tree, of whose ghosts nothing is known."""
    quality = dataclasses.replace(result.quality, ghosts=None, exchanges=())
    return dataclasses.replace(result, tree=tree, sections=None, quality=quality)


def with_ghost(result):
    """The first half of the longest branch is a probable ghost, nothing else."""
    branches = result.tree.branches
    which = int(np.argmax([branch.length_mm for branch in branches]))
    points = [np.full(len(branch), 0.05) for branch in branches]
    half = branches[which].arc_mm <= 0.5 * branches[which].length_mm
    points[which] = np.where(half, 0.8, 0.1)
    ghost = ProbableGhost(
        branch=which, start_mm=0.0, end_mm=0.5 * branches[which].length_mm, probability=0.8
    )
    found = Ghosts(
        points=tuple(points), branches=np.array([told.mean() for told in points]), share=0.2,
        probable=(ghost,), stretches=None, figures=None,
    )  # fmt: skip
    return dataclasses.replace(result, quality=dataclasses.replace(result.quality, ghosts=found))
