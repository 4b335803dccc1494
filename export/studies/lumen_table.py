"""How well the lumen comes out: stenosis, radius, branch lengths, branches found."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError
from gcar_deploy.measure.lumen import BranchLumen, tree_lumens
from gcar_deploy.tree.tree import Tree, along
from gcar_export.scenes.label_files import label_files
from gcar_export.scenes.labels import case_stem
from gcar_export.scenes.stenosis_cases import (
    StenosisCase,
    Tube,
    generated_tubes,
    label_tubes,
    pictures,
    with_stenosis,
)

#: a true centreline point with a reconstructed one this near is matched, mm
NEAR_MM = 2.0
#: a branch longer than this counts; it is found when so much of it is matched
MIN_BRANCH_MM, FOUND_SHARE = 10.0, 0.8


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class LumenRow:
    """One case: errors are reconstruction minus truth.

    Attributes
    ----------
    percent : the true stenosis
    mld_error_mm, stenosis_error : of the minimal lumen diameter, mm, and of the percentage, points;
        None where the lesion's stretch was not found, or its branch is too short to say
    radius_error_mm : (n,) at every matched point of the centreline
    length_errors : of every found branch, mm
    branches, found : branches longer than ``MIN_BRANCH_MM``, and how many of them were found
    status : of the result; ``refused`` has no figures
    """

    name: str
    status: str
    percent: float
    mld_error_mm: float | None = None
    stenosis_error: float | None = None
    radius_error_mm: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    length_errors: tuple[float, ...] = ()
    branches: int = 0
    found: int = 0


def lumen_rows(
    data: Path | None, count: int, on_case: Callable[[], None] | None = None
) -> list[LumenRow]:
    """Make the cases, reconstruct and measure them.

    Parameters
    ----------
    data : folder with label volumes (``label_files``); None takes generated trees
    count : cases; of label volumes as many stenoses a tree as it takes

    Raises
    ------
    UsageError
        There is no label volume.
    """
    engine = Engine()
    labels = label_files(data) if data else []
    trees = {path: label_tubes(path) for path in labels}
    rows = []
    for k in range(count):
        # Away from the seeds of training, which count up from 0.
        rng = np.random.default_rng(9_000_000 + k)
        if labels:
            path = labels[k % len(labels)]
            name, vessels = case_stem(path), trees[path]
        else:
            name, vessels = f"generated {k}", generated_tubes(9_000_000 + k)
        case = with_stenosis(name, vessels, rng)
        if case is not None:
            rows.append(measure_case(engine, case))
        if on_case is not None:
            on_case()
    return rows


def measure_case(engine: Engine, case: StenosisCase) -> LumenRow:
    """Reconstruct one case and compare it with its truth."""
    angiograms, grid = pictures(case)
    try:
        result = engine.reconstruct(angiograms, grid)
    except GcarError:
        return LumenRow(name=case.name, status="refused", percent=case.lesion.percent)
    return compare(case, result.tree, result.status, result.measured.lumens)


def compare(
    case: StenosisCase,
    tree: Tree,
    status: str = "ok",
    lumens: Sequence[BranchLumen] | None = None,
) -> LumenRow:
    """Measure a tree against the case that it should be; without ``lumens`` by its own radii."""
    points, radii, graph = tree.points(), tree.radii(), point_graph(tree)
    lookup = cKDTree(points)
    errors, lengths, branches, found = [], [], 0, 0
    for vessel in case.vessels:
        gap, at = lookup.query(vessel.points_mm)
        matched = gap <= NEAR_MM
        errors.append(radii[at[matched]] - vessel.radius_mm[matched])
        if vessel.arc_mm[-1] <= MIN_BRANCH_MM:
            continue
        branches += 1
        if matched.mean() >= FOUND_SHARE:
            found += 1
            lengths.append(_length_error(vessel, matched, at, graph))
    mld, percent = _lesion(case, tree, tree_lumens(tree) if lumens is None else lumens)
    return LumenRow(
        name=case.name,
        status=status,
        percent=case.lesion.percent,
        mld_error_mm=None if mld is None else mld - case.lesion.minimal_diameter_mm,
        stenosis_error=None if percent is None else percent - case.lesion.percent,
        radius_error_mm=np.concatenate(errors),
        length_errors=tuple(error for error in lengths if np.isfinite(error)),
        branches=branches,
        found=found,
    )


def point_graph(tree: Tree) -> sparse.csr_matrix:
    """(n, n) distances between neighbouring points of a tree, joined at its nodes."""
    rows, columns, values, first = [], [], [], 0
    ends: dict[int, list[int]] = {}
    for branch in tree.branches:
        index = np.arange(first, first + len(branch))
        rows.append(index[:-1])
        columns.append(index[1:])
        values.append(np.maximum(np.diff(branch.arc_mm), 1e-9))
        ends.setdefault(branch.start, []).append(int(index[0]))
        ends.setdefault(branch.end, []).append(int(index[-1]))
        first += len(branch)
    for meeting in ends.values():
        # Explicit zeros would be read as no link at all.
        rows.append(np.full(len(meeting) - 1, meeting[0]))
        columns.append(np.array(meeting[1:], dtype=int))
        values.append(np.full(len(meeting) - 1, 1e-9))
    place = (np.concatenate(rows).astype(int), np.concatenate(columns).astype(int))
    return sparse.csr_matrix((np.concatenate(values), place), shape=(first, first))


def _length_error(
    vessel: Tube, matched: np.ndarray, at: np.ndarray, graph: sparse.csr_matrix
) -> float:
    """Length along the tree minus true length, between the first and last matched point."""
    which = np.flatnonzero(matched)
    true = vessel.arc_mm[which[-1]] - vessel.arc_mm[which[0]]
    reach = dijkstra(graph, directed=False, indices=int(at[which[0]]))
    return float(reach[at[which[-1]]] - true)


def _lesion(
    case: StenosisCase, tree: Tree, lumens: Sequence[BranchLumen]
) -> tuple[float | None, float | None]:
    """Minimal diameter and % stenosis of the reconstruction within the true lesion."""
    vessel, lesion = case.vessels[case.lesion.vessel], case.lesion
    arc, lookup = vessel.arc_mm, cKDTree(vessel.points_mm)
    least, percent = None, None
    for branch, lumen in zip(tree.branches, lumens, strict=True):
        own = lumen.sections
        gap, nearest = lookup.query(along(branch.points_mm, branch.arc_mm, own.arc_mm))
        inside = (gap <= NEAR_MM) & (
            np.abs(arc[nearest] - lesion.middle_mm) <= lesion.length_mm / 2
        )
        if not inside.any():
            continue
        diameter = np.where(inside, own.diameter_mm, np.inf)
        k = int(np.argmin(diameter))
        if least is not None and diameter[k] >= least:
            continue
        least, percent = float(diameter[k]), None
        if lumen.clear[k]:
            percent = 100 * (1 - least / float(lumen.reference_mm[k]))
    return least, percent


def table(rows: Sequence[LumenRow]) -> str:
    """Markdown of all figures, with how many cases each rests on."""
    out = [
        "| figure | n | bias ± SD | median of absolute | 95 % of absolute |",
        "|---|---|---|---|---|",
    ]
    groups = [("all", rows)]
    groups += [
        (f"{low}-{high} %", [row for row in rows if low <= row.percent < high])
        for low, high in ((30, 50), (50, 70))
    ]
    for name, group in groups:
        mld = [row.mld_error_mm for row in group if row.mld_error_mm is not None]
        percent = [row.stenosis_error for row in group if row.stenosis_error is not None]
        out.append(_line(f"minimal lumen diameter, mm ({name})", mld))
        out.append(_line(f"% diameter stenosis, points ({name})", percent))
    radius = np.concatenate([np.zeros(0), *(row.radius_error_mm for row in rows)])
    out.append(_line("radius, mm (centreline points)", radius))
    out.append(_line("branch length, mm", [e for row in rows for e in row.length_errors]))
    branches, found = sum(row.branches for row in rows), sum(row.found for row in rows)
    refused = sum(row.status == "refused" for row in rows)
    missed = sum(row.mld_error_mm is None and row.status != "refused" for row in rows)
    out.append("")
    out.append(
        f"{len(rows)} cases, {refused} refused; lesion not found in {missed}; "
        f"{found} of {branches} branches over {MIN_BRANCH_MM:g} mm found "
        f"({found / max(branches, 1):.0%})"
    )
    return "\n".join(out)


def _line(name: str, errors: Sequence[float] | np.ndarray) -> str:
    e = np.asarray(errors, dtype=float)
    if not len(e):
        return f"| {name} | 0 | - | - | - |"
    size = np.abs(e)
    return (
        f"| {name} | {len(e)} | {e.mean():+.2f} ± {e.std():.2f} | {np.median(size):.2f} | "
        f"{np.percentile(size, 95):.2f} |"
    )
