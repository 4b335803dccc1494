"""How well diameters come out on lumens of known area, and how often a lesion is seen in none."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.measure.lesions import LESION_SHARE
from gcar_deploy.measure.lumen import BranchLumen
from gcar_deploy.result import Result
from gcar_deploy.tree.tree import along
from gcar_export.scenes.label_files import label_files
from gcar_export.scenes.lumen_vessels import LumenCase, ivus_shapes, lumen_case, taken
from gcar_export.scenes.stenosis_cases import (
    Lesion,
    StenosisCase,
    Tube,
    generated_tubes,
    label_tubes,
    pictures,
)

KINDS = ("path", "raw", "mask")
#: a section this near to the true axis belongs to it, mm; this far from its ends it is compared
NEAR_MM, END_MM = 2.0, 4.0
#: label volumes whose centrelines are used, and the shortest of them, mm
VOLUMES, LEAST_MM = 2, 45.0


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class VesselRow:
    """One case: errors are found minus true; None where the lesion was not measured.

    Attributes
    ----------
    least_mm, reference_mm : of the least diameter and of the reference there
    percent : of the % stenosis, points
    curve_mm, z : (n,) error of every measured section, and over its stated sigma
    """

    case: LumenCase
    refused: bool = False
    least_mm: float | None = None
    reference_mm: float | None = None
    percent: float | None = None
    curve_mm: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    z: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))


def vessel_rows(
    data: Path | None, count: int, on_case: Callable[[], None] | None = None
) -> list[VesselRow]:
    """Make ``count`` cases of every kind of picture, reconstruct and measure them."""
    lines, shapes = _lines(data), _shapes(data)
    names = ("round", "oval", "ivus") if shapes else ("round", "oval")
    engine, rows = Engine(), []
    for kind in KINDS:
        for k in range(count):
            # Away from the seeds of training, which count up from 0.
            case = lumen_case(kind, names[k % len(names)], 9_200_000 + k, lines, shapes)
            rows.append(measure_vessel(engine, case))
            if on_case is not None:
                on_case()
    return rows


def _lines(data: Path | None) -> list[np.ndarray]:
    """Centrelines: of label volumes where there are some, else generated."""
    found = label_files(data)[:VOLUMES] if data else []
    tubes = [tube for path in found for tube in label_tubes(path)]
    tubes = tubes or [tube for k in range(4) for tube in generated_tubes(9_200_000 + k)]
    return [tube.points_mm for tube in tubes if tube.arc_mm[-1] >= LEAST_MM]


def _shapes(data: Path | None) -> list[np.ndarray]:
    return [ivus_shapes(path) for path in sorted((data / "ivus").glob("*.csv.gz"))] if data else []


def measure_vessel(engine: Engine, case: LumenCase) -> VesselRow:
    """Reconstruct one case and compare its sections with the true ones."""
    angiograms = taken(case.vessel, case.taking, np.random.default_rng(case.seed))
    grid = Grid(center_mm=(0, 0, 0), size_mm=(128, 128, 128), shape=(128, 128, 128))
    try:
        result = engine.reconstruct(angiograms, grid)
    except GcarError:
        return VesselRow(case=case, refused=True)
    return compare(case, result)


def compare(case: LumenCase, result: Result) -> VesselRow:
    """Compare the sections of a result with the case that it should be."""
    vessel, begin_end = case.vessel, case.vessel.lesion_mm or (0.0, 0.0)
    arc, true, lookup = vessel.arc_mm, vessel.diameter_mm, cKDTree(vessel.points_mm)
    errors, z, least = [np.zeros(0)], [np.zeros(0)], None
    for lumen, points in _sections(result):
        own = lumen.sections
        gap, at = lookup.query(points)
        near = (gap <= NEAR_MM) & (arc[at] > END_MM) & (arc[at] < arc[-1] - END_MM)
        error = own.diameter_mm - true[at]
        use = near & own.measured
        errors.append(error[use])
        z.append((error / own.sigma_mm)[use])
        inside = near & (arc[at] >= begin_end[0]) & (arc[at] <= begin_end[1])
        if inside.any():
            k = int(np.argmin(np.where(inside, own.diameter_mm, np.inf)))
            if least is None or own.diameter_mm[k] < least[0]:
                least = float(own.diameter_mm[k]), float(lumen.reference_mm[k]), int(at[k])
    row = VesselRow(case=case, curve_mm=np.concatenate(errors), z=np.concatenate(z))
    if least is None:
        return row
    found, reference, place = least
    lesion = (arc >= begin_end[0]) & (arc <= begin_end[1])
    return dataclasses.replace(
        row,
        least_mm=found - float(true[lesion].min()),
        reference_mm=reference - float(vessel.healthy_mm[place]),
        percent=100 * (1 - found / reference) - case.percent,
    )


def _sections(result: Result) -> Iterator[tuple[BranchLumen, np.ndarray]]:
    for branch, lumen in zip(result.tree.branches, result.measured.lumens, strict=True):
        yield lumen, along(branch.points_mm, branch.arc_mm, lumen.sections.arc_mm)


def false_lesions(count: int, on_case: Callable[[], None] | None = None) -> tuple[int, int]:
    """Lesions seen in generated trees without one, and vessels in which one could be stated."""
    engine, seen, vessels = Engine(), 0, 0
    for k in range(count):
        tubes = tuple(_healthy(tube) for tube in generated_tubes(9_400_000 + k))
        angiograms, grid = pictures(StenosisCase(f"healthy {k}", tubes, Lesion(0, 0, 0, 0, 0)))
        try:
            result = engine.reconstruct(angiograms, grid)
        except GcarError:
            continue
        found = [m.stenosis_percent for m in result.measured.lumens]
        stated = [percent for percent in found if percent is not None]
        vessels += len(stated)
        seen += sum(percent >= 100 * LESION_SHARE for percent in stated)
        if on_case is not None:
            on_case()
    return seen, vessels


def _healthy(tube: Tube) -> Tube:
    """Return the vessel with the straight taper that fits it."""
    line = np.polyval(np.polyfit(tube.arc_mm, tube.radius_mm, 1), tube.arc_mm)
    return dataclasses.replace(tube, radius_mm=np.maximum(line, 0.4))


def vessel_table(rows: Sequence[VesselRow]) -> str:
    """Markdown: bias ± 1.96 standard deviations (limits of agreement) by group of cases."""
    out = [
        "| pictures | cases | n | least diameter, mm | reference, mm | % stenosis, points "
        "| curve, mm | z² |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kind in KINDS:
        own = [row for row in rows if row.case.taking.kind == kind]
        groups = {"all": own}
        for shape in ("round", "oval", "ivus"):
            groups[shape] = [row for row in own if row.case.shape == shape]
        for pixel in (0.15, 0.2, 0.3, 0.4):
            groups[f"{pixel:g} mm pixels"] = [r for r in own if r.case.taking.pixel_mm == pixel]
        groups["up to 80 %"] = [row for row in own if row.case.percent <= 80]
        groups["above 80 %"] = [row for row in own if row.case.percent > 80]
        out += [_line(kind, name, group) for name, group in groups.items() if group]
    refused = {k: sum(r.refused for r in rows if r.case.taking.kind == k) for k in KINDS}
    out.append("")
    out.append("Refused: " + ", ".join(f"{k} {n}" for k, n in refused.items()))
    return "\n".join(out)


def _line(kind: str, name: str, rows: Sequence[VesselRow]) -> str:
    found = [row for row in rows if row.least_mm is not None]
    curve = np.concatenate([np.zeros(0), *(row.curve_mm for row in rows)])
    z = np.concatenate([np.zeros(0), *(row.z for row in rows)])
    cells = [
        _limits([row.least_mm for row in found], 2),
        _limits([row.reference_mm for row in found], 2),
        _limits([row.percent for row in found], 1),
        _limits(curve, 2),
        f"{np.mean(z**2):.1f}" if len(z) else "-",
    ]
    return f"| {kind} | {name} | {len(found)} of {len(rows)} | " + " | ".join(cells) + " |"


def _limits(errors: Sequence[float | None] | np.ndarray, digits: int) -> str:
    e = np.asarray(errors, dtype=float)
    return f"{e.mean():+.{digits}f} ± {1.96 * e.std():.{digits}f}" if len(e) else "-"
