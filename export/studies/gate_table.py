"""Judge and choose the gates between ``ok``, ``degraded`` and ``refused`` by pairs of known kind.

Every pair is reconstructed with its gates open, so that one run tells what any gates would say:
disagreement, coverage, support, and whatever else lowers a status. ``replayed`` asks the
runtime's own checks. Gates are chosen on one population of generated trees and judged on
another; real trees are only looked at.

The rule: each pair costs what its status is worth. Costs are averaged over the true pairs and over
the wrong ones, in path lengths and in raw pictures, and the four means are added. The gates with
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
import functools
import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gcar_deploy.config import QualityOptions, RunOptions
from gcar_deploy.engine import Engine
from gcar_deploy.errors import RefusedError
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.imaging.net import Segmenter, load_segmenter
from gcar_deploy.imaging.parts import largest_part
from gcar_deploy.measure.metrics import volume_dice
from gcar_deploy.pose import agreement
from gcar_deploy.quality.gates import check_agreement, check_order
from gcar_deploy.quality.status import DEGRADED, OK, REFUSED, ViewQuality, check_explained
from gcar_export.scenes.protocols import case_geometry
from gcar_export.studies.gate_pairs import (
    KINDS,
    PICTURES,
    WRONG,
    Pair,
    Subject,
    generated_subject,
    make_pair,
)
from gcar_export.studies.pose_table import aligned, chamfer_mm

#: cost of a status where the views show one tree, and where they contradict each other
COST_TRUE = {OK: 0.0, DEGRADED: 0.25, REFUSED: 1.0}
COST_WRONG = {OK: 3.0, DEGRADED: 0.5, REFUSED: 0.0}
#: volume DSC from which on a tree has come out
CAME_OUT = 0.5
#: gates that change the sum by less are left as they are
LEAST_GAIN = 0.04
#: gate -> values that are tried. Raw pairs are reconstructed from their largest parts as well
#: where these agree better than the whole, which disagrees by more than the least value here.
GATES: dict[str, tuple[float, ...]] = {
    name: tuple(np.round(np.arange(low, high, step), 3).tolist())
    for name, low, high, step in (
        ("good_disagreement", 0.02, 0.2, 0.005),
        ("max_disagreement", 0.04, 0.6, 0.01),
        ("sure_disagreement_raw", 0.05, 0.4, 0.01),
        ("good_disagreement_raw", 0.05, 0.4, 0.01),
        ("max_disagreement_raw", 0.15, 1.0, 0.01),
        ("parts_disagreement_raw", 0.1, 1.0, 0.01),
        ("order_ratio", 0.5, 2.0, 0.02),
        ("good_coverage", 0.5, 1.0, 0.01),
        ("min_coverage", 0.0, 0.9, 0.01),
        ("good_support", 0.5, 1.0, 0.01),
        ("min_support", 0.0, 0.9, 0.01),
    )
}
_PARTS_FROM = min(GATES["parts_disagreement_raw"])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Attempt:
    """What came of a pair with open gates.

    Attributes
    ----------
    disagreement : along the epipolar lines, after the estimated correction
    shift_mm, turn_deg : that correction
    coverage, support : per view, None where undefined
    findings : reasons for ``degraded`` that have other gates
    refused : reason for a refusal that has another gate, else empty
    dsc : volume DSC at 0.5 with the tree of view 1, None where undefined
    shape_mm : Chamfer distance of the centrelines after rigid alignment, likewise
    """

    disagreement: float
    shift_mm: float
    turn_deg: float
    coverage: tuple[float | None, ...] = ()
    support: tuple[float | None, ...] = ()
    findings: tuple[str, ...] = ()
    refused: str = ""
    dsc: float | None = None
    shape_mm: float | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One pair: what it is, and what came of it.

    Attributes
    ----------
    population : seed of generated trees, or ``real``
    tree, kind, pictures, level : see ``gate_pairs``
    contrast, background, photons : of raw pictures, else None
    whole : from all that was found in the pictures
    parts : from the largest part of each, None where that was not asked
    other_order : disagreement of the pictures with each other's geometry, None where a picture
        shows no vessel
    """

    population: str
    tree: str
    kind: str
    pictures: str
    level: float
    contrast: float | None
    background: float | None
    photons: float | None
    whole: Attempt
    parts: Attempt | None
    other_order: float | None

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What tells this pair from all others."""
        return self.population, self.tree, self.kind, self.pictures

    @property
    def came_out(self) -> bool:
        """Whether the tree was found, from the whole pictures or from their parts."""
        tried = [attempt.dsc or 0.0 for attempt in (self.whole, self.parts) if attempt]
        return max(tried) >= CAME_OUT


def measure(
    out: Path,
    seed: int,
    trees: int,
    on_pair: Callable[[], None] | None = None,
    kinds: Sequence[str] = KINDS,
) -> list[Row]:
    """Reconstruct all pairs of generated trees that ``out`` does not hold yet.

    Parameters
    ----------
    out : file of JSON lines, may be missing
    seed, trees : population of generated trees, and how many of it
    on_pair : called after each pair
    kinds : of ``KINDS``

    Returns
    -------
    rows of this population
    """
    makers = [_generated(seed, k) for k in range(trees + 1)]
    return _measured(out, str(seed), makers, trees, kinds, seed, on_pair)


def measure_real(
    out: Path,
    makers: Sequence[Callable[[], Subject]],
    kinds: Sequence[str],
    on_pair: Callable[[], None] | None = None,
) -> list[Row]:
    """Do the same for given trees, two or more, each followed by the next as the other patient."""
    return _measured(out, "real", makers, len(makers), kinds, 0, on_pair)


def _measured(
    out: Path,
    population: str,
    makers: Sequence[Callable[[], Subject]],
    count: int,
    kinds: Sequence[str],
    seed: int,
    on_pair: Callable[[], None] | None,
) -> list[Row]:
    rows = {row.key: row for row in read_rows(out)}
    engines = open_engines()
    made: dict[int, Subject] = {}
    found = []
    for k, kind, pictures in itertools.product(range(count), kinds, PICTURES):
        following = (k + 1) % len(makers)
        made = {i: made.get(i) or makers[i]() for i in (k, following)}
        key = (population, made[k].name, kind, pictures)
        if key not in rows:
            pair = make_pair(made[k], made[following], kind, pictures, seed)
            rows[key] = examined(pair, made[k], population, pictures, engines)
            with out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(dataclasses.asdict(rows[key])) + "\n")
        found.append(rows[key])
        if on_pair is not None:
            on_pair()
    return found


def open_engines() -> dict[str, Engine]:
    """Return engines that take the ``whole`` pictures and their largest ``parts``, gates open."""
    return {name: Engine(threads=1, options=_open(name)) for name in ("whole", "parts")}


def examined(
    pair: Pair, subject: Subject, population: str, pictures: str, engines: dict[str, Engine]
) -> Row:
    """Reconstruct one pair with open gates, from the whole pictures and from their parts."""
    whole = _attempt(pair, subject, engines["whole"])
    parts = None
    if pair.raw is not None and whole.disagreement > _PARTS_FROM:
        parts = _attempt(pair, subject, engines["parts"])
        parts = parts if parts.disagreement < whole.disagreement else None
    return Row(
        population=population, tree=subject.name, kind=pair.kind, pictures=pictures,
        level=pair.level,
        contrast=pair.raw.contrast_per_mm if pair.raw else None,
        background=pair.raw.background if pair.raw else None,
        photons=pair.raw.photons if pair.raw else None,
        whole=whole, parts=parts, other_order=_other_order(pair, engines["whole"]),
    )  # fmt: skip


def _attempt(pair: Pair, subject: Subject, engine: Engine) -> Attempt:
    """Reconstruct; a refusal by another gate is stated with the views' disagreement."""
    try:
        result = engine.reconstruct(pair.angiograms, case_geometry("clinical", 2)[1])
    except RefusedError as error:
        return _refused(pair, engine, str(error))
    views, pose = result.quality.views, max(result.poses, key=lambda pose: pose.after)
    dsc = shape = None
    if pair.kind != "two trees":
        dsc = volume_dice(subject.truth, result.volume).value
        made = result.tree.points()
        shape = chamfer_mm(aligned(made, subject.line_mm), subject.line_mm)
    return Attempt(
        disagreement=pose.after,
        shift_mm=pose.shift_mm,
        turn_deg=pose.turn_deg,
        coverage=tuple(view.coverage for view in views),
        support=tuple(view.support for view in views),
        findings=result.quality.findings,
        dsc=dsc,
        shape_mm=shape,
    )


def _other_order(pair: Pair, engine: Engine) -> float | None:
    try:
        views = _vessels(pair, engine.options)
    except RefusedError:
        return None
    taken = agreement.agreeing(pair.angiograms, views, engine.options)[0]
    return agreement.other_order(taken, engine.options)


def _vessels(pair: Pair, options: RunOptions) -> list[VesselImage]:
    network = None if pair.raw is None else _network()
    return [extract_vessels(a, options.imaging, network) for a in pair.angiograms]


@functools.cache
def _network() -> Segmenter | None:
    return load_segmenter("auto", 1)


def _refused(pair: Pair, engine: Engine, reason: str) -> Attempt:
    try:
        views = _vessels(pair, engine.options)
    except RefusedError:
        return Attempt(disagreement=1.0, shift_mm=0.0, turn_deg=0.0, refused=reason)
    if engine.options.quality.parts_disagreement_raw < 0:
        views = [largest_part(view) for view in views]
    pose = agreement.poses_between(views, engine.options)[1]
    return Attempt(
        disagreement=pose.after, shift_mm=pose.shift_mm, turn_deg=pose.turn_deg, refused=reason
    )


def replayed(row: Row, gates: QualityOptions) -> str:
    """Return the status that a pair would get by some gates."""
    attempt, calibrated = row.whole, row.pictures == "path length"
    if (
        row.parts is not None
        and row.whole.disagreement > gates.parts_disagreement_raw
        and row.parts.disagreement <= gates.good_disagreement_raw
    ):
        attempt = row.parts
    views = [
        ViewQuality(view_id=str(k + 1), name="", coverage=coverage, support=support,
                    distance_mm=None, overlap=None)
        for k, (coverage, support) in enumerate(
            zip(attempt.coverage, attempt.support, strict=True)
        )
    ]  # fmt: skip
    if attempt.refused:
        return REFUSED
    findings: list[str] = list(attempt.findings)
    if attempt is row.whole:  # the parts alone are ``degraded`` in any case
        findings += check_order(
            ("1", "2"), attempt.disagreement, row.other_order, calibrated, gates
        )[0]
    try:
        findings += check_agreement(("1", "2"), attempt.disagreement, calibrated, gates)
        findings += check_explained(views, attempt.disagreement, calibrated, gates)
    except RefusedError:
        return REFUSED
    return DEGRADED if findings else OK


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
        and gates.min_coverage <= gates.good_coverage
        and gates.min_support <= gates.good_support
    )


def _open(name: str) -> RunOptions:
    """Options that never refuse or degrade by the gates in question."""
    options = RunOptions()
    gates = dataclasses.replace(
        options.quality,
        good_disagreement=2.0, max_disagreement=2.0,
        sure_disagreement_raw=2.0, good_disagreement_raw=2.0, max_disagreement_raw=2.0,
        parts_disagreement_raw=-1.0 if name == "parts" else 2.0,
        order_ratio=0.0, swapped_ratio=0.0,
        good_coverage=0.0, min_coverage=0.0, good_support=0.0, min_support=0.0,
    )  # fmt: skip
    return dataclasses.replace(options, quality=gates)


def _generated(seed: int, number: int) -> Callable[[], Subject]:
    return lambda: generated_subject(seed, number)


def read_rows(file: Path) -> list[Row]:
    """Rows of earlier runs; none where there is no file."""
    if not file.is_file():
        return []
    rows = []
    for line in file.read_text(encoding="utf-8").splitlines():
        held = json.loads(line)
        for name in ("whole", "parts"):
            if held[name] is not None:
                lists = {k: tuple(v) for k, v in held[name].items() if isinstance(v, list)}
                held[name] = Attempt(**(held[name] | lists))
        rows.append(Row(**held))
    return rows
