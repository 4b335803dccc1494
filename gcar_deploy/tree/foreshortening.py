"""How much of a tree's length a view loses to looking along it."""

from __future__ import annotations

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.tree.tree import Tree


def foreshortening(tree: Tree, carm: CArm) -> float | None:
    """Share of the tree's length lost: 1 - sum |dl x ray| / sum |dl|; None without a tree."""
    seen = total = 0.0
    for branch in tree.branches:
        step = np.diff(branch.points_mm, axis=0)
        middle = 0.5 * (branch.points_mm[1:] + branch.points_mm[:-1])
        ray = middle - carm.source_mm
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        seen += float(np.linalg.norm(np.cross(step, ray), axis=1).sum())
        total += float(np.linalg.norm(step, axis=1).sum())
    return 1.0 - seen / total if total > 0 else None
