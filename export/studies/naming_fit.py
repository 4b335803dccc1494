"""Fit what ``gcar_deploy.measure.naming`` holds: ``python -m gcar_export.studies.naming_fit``.

Means and spreads of the figures are those of the right readings; weights (0 or more) and biases
maximise the likelihood of the right reading, or of none, among all readings of each component
(conditional logit, with a weak pull of all weights to one value).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from gcar_deploy.measure.naming import (
    LEFT_FIGURES,
    RIGHT_FIGURES,
    Template,
    read_anatomy,
    readings,
)
from gcar_export.studies.command import ended
from gcar_export.studies.naming_cases import (
    KINDS,
    NAMES,
    NamedTree,
    components,
    named_case,
    right_reading,
)
from gcar_export.studies.naming_real import real_cases

FIGURES = {"left": LEFT_FIGURES, "right": RIGHT_FIGURES}
#: seeds of the generator that training counts up from; judged ones begin elsewhere
FIT_SEED, JUDGE_SEED = 30_000_000, 31_000_000
#: pull of the weights, the value they are pulled to, and the largest, of an independent figure
PULL, USUAL_WEIGHT, MOST_WEIGHT = 2.0, 0.3, 1.0
#: share of components without a right reading in what is met later, not in what is fitted
NONE_SHARE = 0.3
#: a real component counts as so many generated ones
REAL_STRESS = 4.0
#: spreads of figures (directions, logarithms, shares, 20 mm) are at least so much: patients vary
#: more than generated trees
LEAST_SD = 0.35


@dataclasses.dataclass(frozen=True, eq=False)
class Example:
    """Readings of one component: side (0 left, 1 right) and figures; -1: none is right.

    ``patient`` is empty where it was generated.
    """

    side: np.ndarray
    figures: list[np.ndarray]
    right: int
    patient: str = ""


def cases(first: int, count: int) -> Iterator[NamedTree]:
    """Trees of all kinds: as they are left, right and whole, and one of each other kind."""
    for k in range(count):
        which = ("left", "right", "whole")
        for kind in KINDS:
            for part in which if kind == "as it is" else which[k % 3 : k % 3 + 1]:
                case = named_case(first + k, kind, part)
                if case is not None:
                    yield case


def examples(first: int, count: int, on_case: Callable[[], None] | None = None) -> list[Example]:
    """Make the readings of many cases."""
    out = []
    for case in cases(first, count):
        out += examples_of(case)
        if on_case is not None:
            on_case()
    return out


def examples_of(case: NamedTree, patient: str = "") -> list[Example]:
    """Make the readings of each component of one case of which it is clear what is right."""
    out = []
    for own in components(case.tree):
        found = readings(case.tree, own)
        right, clear = right_reading(case, found)
        if found and clear:
            side = np.array([reading.side == "right" for reading in found], dtype=int)
            figures = [reading.figures for reading in found]
            out.append(Example(side, figures, -1 if right is None else right, patient))
    return out


def fit(made: list[Example]) -> dict[str, Template]:
    """Fit both sides' templates together."""
    means, spreads = [], []
    for side in (0, 1):
        of_side = [e for e in made if _right_on(e, side)]
        usual = np.stack([e.figures[e.right] for e in of_side])
        share = np.array([_stress(e) for e in of_side])
        means.append(np.average(usual, axis=0, weights=share))
        off = np.average((usual - means[-1]) ** 2, axis=0, weights=share)
        spreads.append(np.maximum(np.sqrt(off), LEAST_SD))
    unit = [Template(m, s, np.eye(len(m)), 0.0) for m, s in zip(means, spreads, strict=True)]
    sizes = [len(m) for m in means]
    tables = [_table(e, unit, sizes) for e in made]
    start = np.concatenate([np.full(sum(sizes), USUAL_WEIGHT), [2.0, 2.0]])
    bounds = [(0.0, MOST_WEIGHT)] * sum(sizes) + [(None, None)] * 2
    share = np.array([_stress(e) for e in made])
    right = float(share[[e.right >= 0 for e in made]].sum() / share.sum())
    none, some = NONE_SHARE / max(1 - right, 1e-9), (1 - NONE_SHARE) / right
    stress = share * np.where([e.right >= 0 for e in made], some, none)
    found = minimize(
        _loss, start, args=(tables, stress), jac=True, method="L-BFGS-B", bounds=bounds
    )
    weights = np.split(found.x[:-2], [sizes[0]])
    return {
        name: Template(means[k], spreads[k], weights[k], float(found.x[-2 + k]))
        for k, name in enumerate(FIGURES)
    }


def _stress(example: Example) -> float:
    return REAL_STRESS if example.patient else 1.0


def _right_on(example: Example, side: int) -> bool:
    return example.right >= 0 and example.side[example.right] == side


def _table(example: Example, unit: list[Template], sizes: list[int]) -> tuple[np.ndarray, int]:
    """(n + 1, unknowns): what each unknown adds to each reading's score; the last is none."""
    first = (0, sizes[0])
    rows = np.zeros((len(example.side) + 1, sum(sizes) + 2))
    for k, (side, figures) in enumerate(zip(example.side, example.figures, strict=True)):
        # With unit weights, a column a figure, the scores are the single terms.
        rows[k, first[side] : first[side] + sizes[side]] = unit[side].scores(figures[None])[0]
        rows[k, sum(sizes) + side] = 1.0
    return rows, example.right


def _loss(
    x: np.ndarray, tables: list[tuple[np.ndarray, int]], stress: np.ndarray
) -> tuple[float, np.ndarray]:
    """Penalised negative log likelihood, components weighed by whether one reading is right."""
    weights = x[:-2] - USUAL_WEIGHT
    total = 0.5 * PULL * float(weights @ weights)
    gradient = np.concatenate([PULL * weights, np.zeros(2)])
    for (rows, right), weight in zip(tables, stress, strict=True):
        score = rows @ x
        score -= score.max()
        share = np.exp(score) / np.exp(score).sum()
        total -= weight * float(np.log(max(share[right], 1e-300)))
        gradient += weight * (share @ rows - rows[right])
    return total, gradient


def as_json(found: dict[str, Template], made_of: str) -> str:
    """Text of ``naming.json``."""
    sides = {
        side: {
            "bias": round(template.bias, 4),
            "figures": [
                {"name": name, "mean": round(float(m), 4), "sd": round(float(s), 4),
                 "weight": round(float(w), 4)}
                for name, m, s, w in zip(
                    FIGURES[side], template.mean, template.sd, template.weight, strict=True
                )
            ],
        }
        for side, template in found.items()
    }  # fmt: skip
    return json.dumps({"made_of": made_of, "sides": sides}, indent=1) + "\n"


def made_of(made: list[Example]) -> str:
    """Say what a fit rests on."""
    real = [example for example in made if example.patient]
    right = sum(example.right >= 0 for example in made)
    return (
        f"{len(made)} components, {right} with a right reading; {len(real)} of them of "
        f"{len({example.patient for example in real})} real patients, the rest generated"
    )


def tally(judged: Iterable[tuple[NamedTree, dict[str, Template] | None]]) -> dict[str, list[float]]:
    """Count branches by their true name (``none``: another vessel, or no right reading at all).

    Returns
    -------
    name to: branches, named rightly, named wrongly, mm, mm named rightly, mm named wrongly
    """
    out: dict[str, list[float]] = {name: [0.0] * 6 for name in (*NAMES, "none")}
    for case, usual in judged:
        found = read_anatomy(case.tree, usual=usual).names
        for branch, name, true in zip(case.tree.branches, found, case.names, strict=True):
            right = name is not None and name.name == true
            wrong = name is not None and not right
            row = out[true or "none"]
            for k, value in enumerate((1, right, wrong)):
                row[k] += value
                row[k + 3] += value * branch.length_mm
    return out


def table(title: str, counts: dict[str, list[float]]) -> str:
    """Markdown of a tally."""
    rows = [f"| {title} | branches | right | wrong | mm | right mm | wrong mm |",
            "|---|---|---|---|---|---|---|"]  # fmt: skip
    for name, row in counts.items():
        rows.append(f"| {name} | " + " | ".join(f"{value:.0f}" for value in row) + " |")
    return "\n".join(rows)


def main() -> None:
    """Fit and write the file; print how the names do on trees that were left out."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trees", type=int, default=48, help="generated patients to fit to")
    parser.add_argument("--judge", type=int, default=12, help="other generated patients")
    parser.add_argument("--data", type=Path, required=True, help="folder with imagecas/")
    parser.add_argument("--out", type=Path, required=True, help="naming.json")
    told = parser.parse_args()
    made = examples(FIT_SEED, told.trees)
    real = real_cases(told.data)
    own: dict[str, list[Example]] = {patient: [] for patient, _ in real}
    for patient, case in real:
        own[patient] += examples_of(case, patient)
    everything = made + [example for examples_ in own.values() for example in examples_]
    found = fit(everything)
    told.out.write_text(as_json(found, made_of(everything)), encoding="utf-8")
    without = {p: fit([e for e in everything if e.patient != p]) for p in own}
    print(made_of(everything))
    print(table("real, left out one by one", tally((c, without[p]) for p, c in real)))
    judged = ((case, found) for case in cases(JUDGE_SEED, told.judge))
    print(table("generated", tally(judged)))


if __name__ == "__main__":
    raise SystemExit(ended(main))
