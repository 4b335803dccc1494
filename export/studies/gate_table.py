"""Judge and choose the gates between ``ok``, ``degraded`` and ``refused`` by pairs of known kind.

Every pair is reconstructed with its gates open, so that one run tells what any gates would say:
disagreement, coverage, support, and whatever else lowers a status. ``replayed`` asks the
runtime's own checks. Gates are chosen on one population of generated trees and judged on
another; real trees are only looked at.

The rule: each pair costs what its status is worth. Costs are averaged over the true pairs and over
the wrong ones, in each kind of pictures, and the means are added. The gates with
the smallest sum are chosen, one after the other until nothing changes; the present one stays where
no other is cheaper by ``LEAST_GAIN``, else the middle of the cheapest range is taken.

====== ==================================================== ===== ========== =========
pair   which                                                ok    degraded   refused
====== ==================================================== ===== ========== =========
true   of one tree, which comes out (DSC of 0.5 and more)   0     1/4        1
wrong  of one tree, which does not come out; two trees;     3     1/2        0
       wrong sign; swapped
====== ==================================================== ===== ========== =========

Pairs off by a shift or an angle do not count: what comes of them is stated beside.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from gcar_deploy.config import QualityOptions
from gcar_deploy.errors import RefusedError
from gcar_deploy.quality import check_agreement, check_explained, check_order, ghost_share
from gcar_deploy.quality.status import DEGRADED, OK, REFUSED, ViewQuality
from gcar_export.studies.gate_pairs import MASKS, WRONG
from gcar_export.studies.gate_rows import PARTS_FROM, Attempt, Row

#: cost of a status where the views show one tree, and where they contradict each other
COST_TRUE = {OK: 0.0, DEGRADED: 0.25, REFUSED: 1.0}
COST_WRONG = {OK: 3.0, DEGRADED: 0.5, REFUSED: 0.0}
#: gates that change the sum by less are left as they are
LEAST_GAIN = 0.04
#: gate -> values that are tried. Raw pairs are reconstructed without unpartnered lines as well
#: where these agree better than the whole, which disagrees by more than the least value here.
GATES: dict[str, tuple[float, ...]] = {
    name: tuple(np.round(np.arange(low, high, step), 3).tolist())
    for name, low, high, step in (
        ("good_disagreement", 0.02, 0.2, 0.005),
        ("max_disagreement", 0.04, 0.6, 0.01),
        ("sure_disagreement_raw", 0.05, 0.4, 0.01),
        ("good_disagreement_raw", 0.05, 0.4, 0.01),
        ("max_disagreement_raw", 0.15, 1.0, 0.01),
        ("parts_disagreement_raw", PARTS_FROM, 1.0, 0.01),
        ("order_ratio", 0.5, 2.0, 0.02),
        ("good_disagreement_mask", 0.05, 0.6, 0.01),
        ("max_disagreement_mask", 0.15, 1.0, 0.01),
        ("order_ratio_mask", 0.5, 2.0, 0.02),
        ("good_ghost_share", 0.02, 0.5, 0.005),
        ("good_coverage", 0.5, 1.0, 0.01),
        ("min_coverage", 0.0, 0.9, 0.01),
        ("good_support", 0.5, 1.0, 0.01),
        ("min_support", 0.0, 0.9, 0.01),
    )
}


def replayed(row: Row, gates: QualityOptions) -> str:
    """Return the status that a pair would get by some gates."""
    attempt, kind = row.whole, kind_of_row(row)
    if (
        row.parts is not None
        and row.whole.disagreement > gates.parts_disagreement_raw
        and row.parts.disagreement <= gates.good_disagreement_raw
    ):
        attempt = row.parts
    views = [
        ViewQuality(view_id=str(k + 1), name="", coverage=coverage, support=support,
                    distance_mm=None, overlap=None, coverage_even=even)
        for k, (coverage, support, even) in enumerate(
            zip(attempt.coverage, attempt.support, attempt.coverage_even, strict=True)
        )
    ]  # fmt: skip
    if attempt.refused:
        return REFUSED
    findings: list[str] = list(attempt.findings)
    if attempt is row.whole:  # the parts alone are ``degraded`` in any case
        findings += check_order(("1", "2"), attempt.disagreement, row.other_order, kind, gates)[0]
    try:
        findings += check_agreement(("1", "2"), attempt.disagreement, kind, gates)
        findings += check_explained(views, attempt.disagreement, kind, gates)
    except RefusedError:
        return REFUSED
    ghosts = expected_ghosts(attempt)
    return DEGRADED if findings or (ghosts or 0.0) > gates.good_ghost_share else OK


def kind_of_row(row: Row) -> str:
    """Return what the gates take the pair's pictures for, see ``quality.kind_of``."""
    return "mask" if row.pictures in MASKS else {"raw": "raw"}.get(row.pictures, "exact")


def expected_ghosts(attempt: Attempt) -> float | None:
    """Share of the tree's length that the shipped model expects in ghosts."""
    if not attempt.figures:
        return None
    return ghost_share(np.array(attempt.figures), np.array(attempt.length_mm))


def cost(rows: Sequence[Row], gates: QualityOptions) -> float:
    """Sum what the statuses cost; see the head of this file."""
    costs: dict[tuple[str, bool], list[float]] = {}
    for row in rows:
        if row.kind == "same" or row.kind in WRONG:
            true = row.kind == "same" and row.came_out
            price = (COST_TRUE if true else COST_WRONG)[replayed(row, gates)]
            costs.setdefault((row.pictures, true), []).append(price)
    return float(sum(np.mean(part) for part in costs.values()))


def choose(rows: Sequence[Row], start: QualityOptions) -> QualityOptions:
    """Return the gates that these rows choose, from ``start`` on; see the head of this file."""
    gates, least = start, cost(rows, start)
    while True:
        before = gates
        for name, values in GATES.items():
            allowed = [value for value in values if _ordered(with_gate(gates, name, value))]
            costs = np.array([cost(rows, with_gate(gates, name, value)) for value in allowed])
            if len(costs) and costs.min() < least - LEAST_GAIN:
                least = float(costs.min())
                gates = with_gate(gates, name, allowed[_middle(costs <= least + 1e-9)])
        if gates == before:
            return gates


def _middle(best: np.ndarray) -> int:
    """Middle of the longest run of true values."""
    runs = np.split(np.arange(len(best)), np.flatnonzero(np.diff(best.astype(int))) + 1)
    longest = max((run for run in runs if best[run[0]]), key=len)
    return int(longest[len(longest) // 2])


def with_gate(gates: QualityOptions, name: str, value: float) -> QualityOptions:
    """Return the gates with one of them changed."""
    changed: dict[str, Any] = {name: value}
    return dataclasses.replace(gates, **changed)


def _ordered(gates: QualityOptions) -> bool:
    """Whether what is refused lies beyond what is degraded."""
    return (
        gates.good_disagreement <= gates.max_disagreement
        and gates.good_disagreement_raw <= gates.max_disagreement_raw
        and gates.good_disagreement_mask <= gates.max_disagreement_mask
        and gates.min_coverage <= gates.good_coverage
        and gates.min_support <= gates.good_support
    )
