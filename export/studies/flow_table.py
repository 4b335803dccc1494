"""Pressure drop behind a stenosis against the same closed forms, or svZeroDSolver, on the truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError
from gcar_deploy.flow import Assumption, PressureDrop, pressure_drop
from gcar_deploy.measure import Sections
from gcar_deploy.measure.lesions import LESION_SHARE
from gcar_deploy.measure.lumen import tree_lumens
from gcar_deploy.result import Result
from gcar_deploy.tree.tree import Tree
from gcar_export.scenes.stenosis_cases import (
    StenosisCase,
    generated_tubes,
    pictures,
    with_stenosis,
)
from gcar_export.scenes.true_trees import joined_tree

#: seeds of the trees: judged ones and those that constants are fitted to, both away from training
JUDGED, FITTED = 9_100_000, 9_200_000
#: percent diameter stenosis that constants are fitted to, drawn evenly, and the seed of the draw
FIT_PERCENT, FIT_SEED = (30.0, 75.0), 777
#: Pd/Pa is compared so far behind a lesion, mm; a point of the truth counts so near, mm
BEHIND_MM, NEAR_MM = 5.0, 2.0
#: diameters are compared only so far from other vessels, mm
CLEAR_MM = 4.0


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class FlowRow:
    """One case.

    Attributes
    ----------
    true_drop_mmhg, drop_mmhg : lost from the ostium to behind the lesion; None where that place
        was not found
    covered, covered_flow : whether the interval holds the truth at the assumed flow, and at one
        drawn from the assumption's own spread
    width : of the interval with both causes
    withheld : why the product would give no value there
    """

    name: str
    status: str
    true_drop_mmhg: float
    drop_mmhg: float | None = None
    covered: bool = False
    covered_flow: bool = False
    width: float | None = None
    withheld: str = ""


@dataclasses.dataclass(frozen=True, eq=False)
class DiameterError:
    """(n,) true and found diameters, stated sigma and healthy diameters, mm, of clear points."""

    true_mm: np.ndarray
    found_mm: np.ndarray
    stated_mm: np.ndarray
    healthy_mm: np.ndarray


def flow_case(seed: int, percent: float) -> StenosisCase | None:
    """Left tree of the generator with one stenosis of so many percent."""
    rng = np.random.default_rng(seed)
    return with_stenosis(f"generated {seed}", generated_tubes(seed), rng, percent)


def flow_rows(
    count: int, percent: float, fit: bool = False, on_case: Callable[[], None] | None = None
) -> tuple[list[FlowRow], list[DiameterError]]:
    """Make cases, reconstruct them, and compare pressure and diameters with the truth.

    Parameters
    ----------
    percent : stenosis of each judged tree
    fit : the trees that constants are fitted to, of all severities, not those that they are
        judged on
    """
    engine, rows, errors = Engine(threads=1), [], []
    for k in range(count):
        seed = (FITTED if fit else JUDGED) + k
        severity = np.random.default_rng(FIT_SEED + k).uniform(*FIT_PERCENT) if fit else percent
        case = flow_case(seed, float(severity))
        if case is not None:
            try:
                result = engine.reconstruct(*pictures(case))
            except GcarError:
                rows.append(FlowRow(name=case.name, status="refused", true_drop_mmhg=np.nan))
            else:
                rows.append(compare(case, *told_of(result), seed))
                errors.append(diameters(case, *result.lumen))
        if on_case is not None:
            on_case()
    return rows, errors


def told_of(result: Result) -> tuple[Tree, PressureDrop, str]:
    """Return what the product tells: lumen, pressure drop, status."""
    return result.lumen[0], result.pressure, result.status


def compare(case: StenosisCase, tree: Tree, drop: PressureDrop, status: str, seed: int) -> FlowRow:
    """Pd/Pa of a tree behind the true lesion, against that of the truth."""
    place, middle = _behind(case), _middle(case)
    truth = joined_tree(case.vessels)
    usual = Assumption()
    true = _at(truth, told(truth, usual), place, middle)
    row = FlowRow(
        name=case.name, status=status,
        true_drop_mmhg=np.nan if true is None else (1 - true[0]) * usual.aortic_pressure_mmhg,
    )  # fmt: skip
    found = _at(tree, drop, place, middle)
    if true is None or found is None:
        return row
    rng = np.random.default_rng(seed)
    drawn = dataclasses.replace(
        usual,
        velocity_m_s=usual.velocity_m_s
        * float(np.exp(np.log1p(usual.relative_flow_sigma) * rng.standard_normal())),
    )
    other = _at(truth, told(truth, drawn), place, middle)
    return dataclasses.replace(
        row,
        drop_mmhg=(1 - found[0]) * usual.aortic_pressure_mmhg,
        covered=found[1] <= true[0] <= found[2],
        covered_flow=other is not None and found[1] <= other[0] <= found[2],
        width=found[2] - found[1],
        withheld=found[3],
    )


def told(tree: Tree, assumed: Assumption) -> PressureDrop:
    """Pressure drop of the truth."""
    return pressure_drop(tree, tree_lumens(tree), assumed)


def diameters(case: StenosisCase, tree: Tree, sections: Sequence[Sections]) -> DiameterError:
    """Compare diameters where one vessel alone is near."""
    own = np.concatenate([np.full(len(v.points_mm), k) for k, v in enumerate(case.vessels)])
    points = np.concatenate([v.points_mm for v in case.vessels])
    radii = np.concatenate([v.radius_mm for v in case.vessels])
    lookup = cKDTree(points)
    gap, at = lookup.query(tree.points())
    clear = np.array([
        g <= 0.5 * NEAR_MM and len(set(own[near])) == 1
        for g, near in zip(gap, lookup.query_ball_point(tree.points(), CLEAR_MM), strict=True)
    ])  # fmt: skip
    healthy = np.concatenate([lumen.healthy_mm for lumen in tree_lumens(tree, sections)])
    stated = np.concatenate([own.sigma_mm for own in sections])
    return DiameterError(
        true_mm=2 * radii[at][clear], found_mm=2 * tree.radii()[clear],
        stated_mm=stated[clear], healthy_mm=healthy[clear],
    )  # fmt: skip


def fitted(errors: Sequence[DiameterError]) -> tuple[float, float, float]:
    """Constants of ``flow.spread``: floor, factor, lost.

    Lost is the median over narrow places, which trees that are wrong there do not move; floor and
    factor make what is left likeliest.
    """
    true, found, stated, healthy = (
        np.concatenate([getattr(e, name) for e in errors])
        for name in ("true_mm", "found_mm", "stated_mm", "healthy_mm")
    )
    narrow = np.maximum(np.nan_to_num(healthy - found), 0.0)
    core = narrow > LESION_SHARE * found
    lost = max(float(np.median((found - true)[core] / narrow[core])), 0.0) if core.any() else 0.0
    left = found - lost * narrow - true

    def cost(log: np.ndarray) -> float:
        floor, factor = np.exp(log)
        variance = floor**2 + (factor * stated) ** 2
        return float(np.mean(0.5 * np.log(variance) + 0.5 * left**2 / variance))

    best = minimize(cost, np.log([0.05, 1.0]), method="Nelder-Mead")
    floor, factor = np.exp(best.x).tolist()
    return floor, factor, lost


def table(rows: Sequence[FlowRow]) -> str:
    """Markdown of errors and coverage."""
    seen = [row for row in rows if row.drop_mmhg is not None]
    if not seen:
        return f"{len(rows)} cases, no lesion found"
    share = np.array([(r.drop_mmhg or 0.0) / r.true_drop_mmhg - 1 for r in seen])
    n = len(seen)
    given = [r for r in seen if not r.withheld]
    within = int((np.abs(share) <= 0.1).sum())
    held = sum(bool(r.withheld) for r in seen)
    return "\n".join([
        "| figure | value |", "|---|---|",
        f"| true pressure drop, median | {np.median([r.true_drop_mmhg for r in seen]):.1f} mmHg |",
        f"| relative error, mean ± SD | {share.mean():+.0%} ± {share.std():.0%} |",
        f"| relative error, median of absolute | {np.median(np.abs(share)):.0%} |",
        f"| within 10 % | {within} of {n} |",
        f"| interval covers, flow as assumed | {sum(r.covered for r in seen)} of {n} |",
        f"| interval covers, flow drawn | {sum(r.covered_flow for r in seen)} of {n} |",
        f"| width of the interval, median | {np.median([r.width or 0.0 for r in seen]):.2f} |",
        f"| value withheld | {held} of {n} |",
        f"| interval covers, of values given | {sum(r.covered for r in given)} of {len(given)} |",
        "",
        f"{len(rows)} cases, {sum(r.status == 'refused' for r in rows)} refused, "
        f"{len(rows) - n} without the lesion",
    ])  # fmt: skip


def _middle(case: StenosisCase) -> np.ndarray:
    """(3,) the middle of the lesion."""
    vessel = case.vessels[case.lesion.vessel]
    return np.array([
        np.interp(case.lesion.middle_mm, vessel.arc_mm, column) for column in vessel.points_mm.T
    ])  # fmt: skip


def _behind(case: StenosisCase) -> np.ndarray:
    """(3,) the place behind the lesion."""
    vessel, lesion = case.vessels[case.lesion.vessel], case.lesion
    at = min(lesion.middle_mm + lesion.length_mm / 2 + BEHIND_MM, vessel.arc_mm[-1])
    return np.array([np.interp(at, vessel.arc_mm, column) for column in vessel.points_mm.T])


def _at(
    tree: Tree, drop: PressureDrop, place: np.ndarray, middle: np.ndarray
) -> tuple[float, float, float, str] | None:
    """Pd/Pa, interval and reason at the point nearest to a place; None where none is near."""
    best: tuple[tuple[bool, float], tuple[float, float, float, str]] | None = None
    for branch, vessel in zip(tree.branches, drop.vessels, strict=True):
        gap = np.linalg.norm(branch.points_mm - place, axis=1)
        k = int(np.argmin(gap))
        through = np.linalg.norm(branch.points_mm - middle, axis=1).min() <= NEAR_MM
        width = bool(through), float(branch.radius_mm[k])
        # Of several the one with the lesion, then the widest: twigs run beside it for a while.
        if gap[k] <= NEAR_MM and np.isfinite(vessel.ratio[k]) and (not best or width > best[0]):
            held = "" if vessel.told[k] else (vessel.withheld or "too wide")
            ratio, low, high = (float(x[k]) for x in (vessel.ratio, vessel.low, vessel.high))
            best = width, (ratio, low, high, held)
    return None if best is None else best[1]
