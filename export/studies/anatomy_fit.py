"""Fit what ``gcar_deploy.quality.anatomy`` holds: ``python -m gcar_export.studies.anatomy_fit``.

Left, right and whole generated trees, cut at their forks as reconstructed ones are; ends and side
branches are missing at random, and at times a piece stands in a wrong place. The network learns to
tell each tree from the same tree after every mistake (conditional logit). A second population
sets the line, a third tells what comes of it.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.quality.anatomy import MISTAKES, TILTED, Usual, odd_figures, odd_signs
from gcar_deploy.tree.curves import resample
from gcar_deploy.tree.tree import Branch, Tree
from gcar_deploy.types import Array, Points, Scalars
from gcar_export.scenes.gantry import random_rotation
from gcar_export.scenes.trees import SyntheticTree, random_tree, rough_style, thin_style
from gcar_export.studies.command import ended

FIT_SEED, LINE_SEED, CHECK_SEED = 71_001, 71_002, 71_003
SIDES = ("left", "right", "whole")
#: share of right trees that may be doubted for each mistake where the lines are set: small, since
#: real trees vary in more ways than generated ones, and a doubt costs a right result its ``ok``
DOUBTED = 0.001
#: a heart is turned by up to so much about any axis, deg
LIE_DEG = 25.0
HIDDEN, EPOCHS, BATCH, RATE, DECAY = 24, 60, 256, 3e-3, 1e-2
#: a fork is where a vessel begins this near to another, mm; shorter pieces are not cut off
_FORK_MM, _LEAST_POINTS = 3.0, 5


def figures_of(seed: int, patients: int) -> tuple[Array, Array]:
    """(n, k) figures of spoilt trees and (n,) which side each is of ``SIDES``."""
    figures, sides = [], []
    for number in range(patients):
        rng = np.random.default_rng([seed, number])
        style = (None, rough_style(rng), thin_style(rng))[rng.choice(3, p=[0.45, 0.45, 0.1])]
        whole = random_tree(rng, style)
        for k, side in enumerate(SIDES):
            tree = spoilt(whole if side == "whole" else whole.sides(side), rng)
            found = odd_figures(tree)
            if found is not None:
                figures.append(found)
                sides.append(k)
    return np.array(figures), np.array(sides)


def spoilt(tree: SyntheticTree, rng: np.random.Generator) -> Tree:
    """Cut a tree at its forks, and lose and misplace parts of it as pictures do."""
    lost, dropped = rng.choice([0, 0.15, 0.4]), rng.choice([0, 0.1, 0.25])
    misplaced = rng.choice([0, 0.1])
    # Hearts of real label volumes lie further apart than the generated ones.
    lie = random_rotation(rng, LIE_DEG)
    pieces = []
    for vessel in tree.vessels:
        if vessel.name not in ("LAD", "LCx", "RCA") and rng.random() < dropped:
            continue
        points, radius = _as_lines(vessel.points_mm, vessel.radius_mm)
        if rng.random() < lost:
            keep = max(int(len(points) * rng.uniform(0.3, 1)), _LEAST_POINTS)
            part = slice(keep) if rng.random() < 0.8 else slice(-keep, None)
            points, radius = points[part], radius[part]
        for piece, own in _cut(points, radius, [v.points_mm[0] for v in tree.vessels]):
            shift = rng.uniform(-15, 15, 3) if rng.random() < misplaced else np.zeros(3)
            pieces.append(_branch((piece + shift) @ lie.T, own))
    nodes = np.array([end for b in pieces for end in (b.points_mm[0], b.points_mm[-1])])
    return Tree(nodes_mm=nodes.reshape(-1, 3), branches=tuple(pieces))


def _as_lines(points: Points, radius: Scalars) -> tuple[Points, Scalars]:
    line = resample(points, 1.0)
    share = np.linspace(0, 1, len(line))
    return line, np.interp(share, np.linspace(0, 1, len(radius)), radius)


def _cut(points: Points, radius: Scalars, starts: list[Points]) -> list[tuple[Points, Scalars]]:
    gap, at = cKDTree(points).query(np.array(starts))
    inner = [k for k in at[gap < _FORK_MM] if _LEAST_POINTS < k < len(points) - _LEAST_POINTS]
    ends = [0, *sorted(set(inner)), len(points) - 1]
    pieces = [slice(a, b + 1) for a, b in itertools.pairwise(ends) if b > a]
    return [(points[piece], radius[piece]) for piece in pieces]


def _branch(points: Points, radius: Scalars) -> Branch:
    n = len(points)
    return Branch(points_mm=points, radius_mm=radius, sigma_mm=np.full(n, np.nan),
                  confidence=np.ones(n), start=0, end=0)  # fmt: skip


def fit(figures: Array) -> Usual:
    """Fit the network, without lines."""
    import torch

    torch.manual_seed(0)
    scale: Scalars = np.sqrt(np.mean(figures**2, axis=0)).round(6)
    signs = np.stack([odd_signs((1, 1, 1)), *(odd_signs(axes) for axes, _ in MISTAKES.values())])
    seen = torch.tensor(figures / scale, dtype=torch.float32)
    turned = torch.tensor(signs, dtype=torch.float32)
    net = torch.nn.Sequential(
        torch.nn.Linear(figures.shape[1], HIDDEN), torch.nn.Tanh(),
        torch.nn.Linear(HIDDEN, 1, bias=False),
    )  # fmt: skip
    steps = EPOCHS * -(-len(seen) // BATCH)
    optimiser = torch.optim.AdamW(net.parameters(), lr=RATE, weight_decay=DECAY)
    slower = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(EPOCHS):
        for part in torch.randperm(len(seen)).split(BATCH):
            scores = net(seen[part][:, None] * turned)[..., 0]
            loss = -torch.log_softmax(scores, dim=1)[:, 0].mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            slower.step()
    weight, offset, out = (p.detach().double().numpy() for p in net.parameters())
    # As many digits as the file keeps, so that the lines hold for what it says.
    weight = np.round(np.column_stack([weight, offset]), 4)
    return Usual(scale, weight, np.round(out[0], 4), {})


def with_lines(usual: Usual, right: Array) -> Usual:
    """Return the network with the lines above which ``DOUBTED`` of right trees' figures lie.

    None is below 0, where a tree lies better as it is than without the mistake.
    """
    odds = {name: doubt(usual, right, (1, 1, 1), name) for name in MISTAKES}
    lines = {
        name: round(max(0.0, float(np.quantile(odd, 1 - DOUBTED))), 4) for name, odd in odds.items()
    }
    return dataclasses.replace(usual, lines=lines)


def as_json(usual: Usual, made_of: str) -> str:
    """Text of ``anatomy.json``."""
    held = {
        "made_of": made_of, "lines": usual.lines, "scale": usual.scale.tolist(),
        "hidden": usual.hidden.tolist(), "out": usual.out.tolist(),
    }  # fmt: skip
    return json.dumps(held) + "\n"


def doubt(usual: Usual, figures: Array, made: Sequence[int], name: str) -> Scalars:
    """(n,) by how much trees that suffered ``made`` score higher with mistake ``name`` undone."""
    given = figures * odd_signs(made)
    return usual.score(given * odd_signs(MISTAKES[name][0])) - usual.score(given)


def table(usual: Usual, figures: Array, sides: Array) -> str:
    """Markdown: share of trees that are doubted, by views, side and mistake."""
    rows = ["| views | trees | " + " | ".join(SIDES) + " |", "|---" * 5 + "|"]
    for views, names in (("tilted", TILTED), ("level", tuple(MISTAKES))):
        kinds = {"right": (1, 1, 1)} | {name: MISTAKES[name][0] for name in names}
        for kind, axes in kinds.items():
            above = [doubt(usual, figures, axes, name) > usual.lines[name] for name in names]
            doubted = np.any(above, axis=0)
            cells = [f"{doubted[sides == k].mean():.1%}" for k in range(len(SIDES))]
            rows.append(f"| {views} | {kind} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def main() -> None:
    """Fit and write the file; print how many right and mistaken trees are doubted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--patients", type=int, default=3000, help="generated, to fit to")
    parser.add_argument("--judge", type=int, default=1500, help="for the lines; as many to check")
    parser.add_argument("--out", type=Path, required=True, help="anatomy.json")
    told = parser.parse_args()
    usual = fit(figures_of(FIT_SEED, told.patients)[0])
    usual = with_lines(usual, figures_of(LINE_SEED, told.judge)[0])
    made_of = f"left, right and whole trees of {told.patients} generated patients"
    told.out.write_text(as_json(usual, made_of), encoding="utf-8")
    print(table(usual, *figures_of(CHECK_SEED, told.judge)))


if __name__ == "__main__":
    raise SystemExit(ended(main))
