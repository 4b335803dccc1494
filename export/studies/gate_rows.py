"""Measure pairs of known kind with open gates, once: what any gates would say follows from it.

Rows are kept as JSON lines, so that a study goes on where an earlier one stopped, and several
studies (``gate_table``, ``ghost_fit``, ``status_table``) read the same.
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
from scipy.spatial import cKDTree

from gcar_deploy.config import RunOptions
from gcar_deploy.engine import Engine
from gcar_deploy.errors import RefusedError
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.imaging.net import Segmenter, load_segmenter
from gcar_deploy.measure.metrics import volume_dice
from gcar_deploy.pose import agreement
from gcar_deploy.quality import GHOST_MM
from gcar_deploy.result import Result
from gcar_export.scenes.protocols import case_geometry
from gcar_export.studies.gate_pairs import (
    KINDS,
    MASKS,
    PICTURES,
    Pair,
    Subject,
    generated_subject,
    make_pair,
    side_of,
)
from gcar_export.studies.pose_table import aligned, chamfer_mm

#: volume DSC from which on a tree has come out
CAME_OUT = 0.5
#: raw pairs are reconstructed without unpartnered lines as well where they disagree by more
PARTS_FROM = 0.1
#: finds the tree that pairs show by its side, and by whether as the common protocol places it
Maker = Callable[[str, bool], Subject]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Attempt:
    """What came of a pair with open gates.

    Attributes
    ----------
    disagreement : along the epipolar lines, after the estimated correction
    shift_mm, turn_deg : that correction
    coverage, support, coverage_even : per view, None where undefined
    findings : reasons for ``degraded`` that have other gates
    refused : reason for a refusal that has another gate, else empty
    dsc : volume DSC at 0.5 with the tree of view 1, None where undefined
    shape_mm : Chamfer distance of the centrelines after rigid alignment, likewise
    figures, length_mm, off : per stretch of the tree what ``quality.ghost_figures`` says of it, its
        length, and the share of it that lies further than ``GHOST_MM`` from view 1's tree
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
    figures: tuple[tuple[float, ...], ...] = ()
    length_mm: tuple[float, ...] = ()
    off: tuple[float, ...] = ()
    coverage_even: tuple[float | None, ...] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One pair: what it is, and what came of it.

    Attributes
    ----------
    population : seed of generated trees, or ``real``
    tree, kind, pictures, level : see ``gate_pairs``
    contrast, background, photons : of raw pictures, else None
    spoilt : whether masks have a segmentation's faults
    whole : from all that was found in the pictures
    parts : without lines that the other view does not show, None where that was not asked
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
    spoilt: bool = False

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
    pictures: Sequence[str] = PICTURES,
) -> list[Row]:
    """Reconstruct all pairs of generated trees that ``out`` does not hold yet.

    Parameters
    ----------
    out : file of JSON lines, may be missing
    seed, trees : population of generated trees, and how many of it
    on_pair : called after each pair
    kinds, pictures : of ``KINDS`` and ``PICTURES``

    Returns
    -------
    rows of this population
    """
    known = functools.lru_cache(maxsize=4)(generated_subject)
    makers = [_anywhere(functools.partial(known, seed, k)) for k in range(trees + 1)]
    pairs = list(itertools.product(range(trees), kinds, pictures))
    return _measured(out, (str(seed), seed), makers, pairs, on_pair)


def measure_real(
    out: Path,
    makers: Sequence[Maker],
    kinds: Sequence[str],
    on_pair: Callable[[], None] | None = None,
) -> list[Row]:
    """Do the same for given trees, two or more, each followed by the next as the other patient."""
    pairs = list(itertools.product(range(len(makers)), kinds, PICTURES))
    return _measured(out, ("real", 0), makers, pairs, on_pair)


def _measured(
    out: Path,
    population: tuple[str, int],
    makers: Sequence[Maker],
    pairs: Sequence[tuple[int, str, str]],
    on_pair: Callable[[], None] | None,
) -> list[Row]:
    rows = {row.key: row for row in read_rows(out)}
    engines = open_engines()
    name, seed = population
    made = functools.lru_cache(maxsize=6)(lambda k, *which: makers[k](*which))
    found = []
    for k, kind, pictures in pairs:
        which = side_of(pictures), pictures in MASKS
        subject, other = made(k, *which), made((k + 1) % len(makers), *which)
        key = (name, subject.name, kind, pictures)
        if key not in rows:
            pair = make_pair(subject, other, kind, pictures, seed)
            rows[key] = examined(pair, subject, name, pictures, engines)
            with out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(dataclasses.asdict(rows[key])) + "\n")
        found.append(rows[key])
        if on_pair is not None:
            on_pair()
    return found


def _anywhere(maker: Callable[[str], Subject]) -> Maker:
    """Let a generated tree stand where it is made, whatever its pictures are."""
    return lambda side, _: maker(side)


def open_engines() -> dict[str, Engine]:
    """Return engines, gates open, that take ``whole`` pictures and the ``parts`` both show."""
    return {name: Engine(threads=1, options=_open(name)) for name in ("whole", "parts")}


def examined(
    pair: Pair, subject: Subject, population: str, pictures: str, engines: dict[str, Engine]
) -> Row:
    """Reconstruct one pair with open gates, from the whole pictures and from their parts."""
    whole = _attempt(pair, subject, engines["whole"])
    parts = None
    if pair.raw is not None and whole.disagreement > PARTS_FROM:
        parts = _attempt(pair, subject, engines["parts"])
        parts = parts if parts.disagreement < whole.disagreement else None
    return Row(
        population=population, tree=subject.name, kind=pair.kind, pictures=pictures,
        level=pair.level,
        contrast=pair.raw.contrast_per_mm if pair.raw else None,
        background=pair.raw.background if pair.raw else None,
        photons=pair.raw.photons if pair.raw else None,
        whole=whole, parts=parts, other_order=_other_order(pair, engines["whole"]),
        spoilt=pair.spoilt,
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
        coverage_even=tuple(view.coverage_even for view in views),
        support=tuple(view.support for view in views),
        findings=result.quality.findings,
        dsc=dsc,
        shape_mm=shape,
        **_stretches(result, subject),
    )


def _stretches(result: Result, subject: Subject) -> dict[str, Any]:
    ghosts = result.quality.ghosts
    if ghosts is None:
        return {}
    gap = cKDTree(subject.line_mm).query(result.tree.points())[0]
    return {
        "figures": tuple(tuple(row) for row in np.round(ghosts.figures, 4).tolist()),
        "length_mm": tuple(np.round(ghosts.stretches.length_mm, 3).tolist()),
        "off": tuple(np.round(ghosts.stretches.mean(1.0 * (gap > GHOST_MM)), 3).tolist()),
    }


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
        views = agreement.agreeing(pair.angiograms, views, engine.options)[0]
    pose = agreement.poses_between(views, engine.options)[1]
    return Attempt(
        disagreement=pose.after, shift_mm=pose.shift_mm, turn_deg=pose.turn_deg, refused=reason
    )


def _open(name: str) -> RunOptions:
    """Options that never refuse or degrade by the gates in question."""
    options = RunOptions()
    gates = dataclasses.replace(
        options.quality,
        good_disagreement=2.0, max_disagreement=2.0,
        good_disagreement_mask=2.0, max_disagreement_mask=2.0,
        sure_disagreement_raw=2.0, good_disagreement_raw=2.0, max_disagreement_raw=2.0,
        parts_disagreement_raw=-1.0 if name == "parts" else 2.0,
        order_ratio=0.0, order_ratio_mask=0.0, swapped_ratio=0.0, good_ghost_share=1.0,
        good_coverage=0.0, min_coverage=0.0, good_support=0.0, min_support=0.0,
    )  # fmt: skip
    return dataclasses.replace(options, quality=gates)


def read_rows(file: Path) -> list[Row]:
    """Rows of earlier runs; none where there is no file."""
    if not file.is_file():
        return []
    rows = []
    for line in file.read_text(encoding="utf-8").splitlines():
        held = json.loads(line)
        for name in ("whole", "parts"):
            if held[name] is not None:
                held[name] = Attempt(**{k: _tuples(v) for k, v in held[name].items()})
        rows.append(Row(**held))
    return rows


def _tuples(value: Any) -> Any:
    """JSON knows lists alone."""
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value
