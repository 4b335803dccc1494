"""Refinement from true points, with and without noise, on real trees: three measures and seconds.

DIR holds ``imagecas/*.label.nii.gz``. Starting points are the centres of the truth's voxels
(any occupancy above 0, the occupancy as confidence); with noise each point is moved by its own
Gaussian offset (standard deviation per axis, in voxels) and 10 % of them are dropped. Both modes
start from the same points, and every measure is taken at its usual threshold.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from gcar_deploy.config import RefineOptions, RefinerName, RunOptions
from gcar_deploy.files import whole_file
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.measure.metrics import (
    VOLUME_THRESHOLD,
    Skeleton,
    overlap_within,
    projection_dice,
    skeleton,
    volume_dice,
)
from gcar_deploy.tubes.refine import refine, refined_volume
from gcar_deploy.types import Array, Volume
from gcar_export.evaluate.evaluate import case_name, find_labels
from gcar_export.evaluate.tables import STARS
from gcar_export.scenes.labels import read_label
from gcar_export.scenes.protocols import Case, make_case
from gcar_export.scenes.raycast import as_label, raycast

DROPPED = 0.1
#: rows of the table: refiner, and whether the loss has its centreline part
MODES: tuple[tuple[RefinerName, bool], ...] = (
    ("tube", False),
    ("tube", True),
    ("paper", False),
    ("paper", True),
)
#: name in a row -> heading
MEASURES = {
    "dsc": "volume DSC(0.5) %",
    "ot_1mm": "Ot(1 mm) %",
    "new_dsc": "new-projection DSC(0.5 mm) %",
}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """A simulated case with everything of the truth that the measures need.

    Attributes
    ----------
    case : Case
    views : vessel images of its pictures
    skeleton : of the true volume
    new_mm : true path lengths in the new views, mm
    """

    case: Case
    views: list[VesselImage]
    skeleton: Skeleton
    new_mm: list[Array]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One fit.

    Attributes
    ----------
    protocol, case : str
    refiner, centreline : the mode
    noise : of the start, voxels
    measures : 0 .. 1 by the names of ``MEASURES``; None where undefined
    cpu_s : CPU seconds of refinement and volume
    settings : digest of the options
    """

    protocol: str
    case: str
    refiner: RefinerName
    centreline: bool
    noise: float
    measures: Mapping[str, float | None]
    cpu_s: float
    settings: str


def start_points(truth: Volume, grid: Grid, noise_voxels: float, seed: int) -> CenterPoints:
    """Centres of occupied voxels; with noise, moved and one in ten dropped."""
    index = np.argwhere(truth > 0)
    confidence = truth[truth > 0].astype(np.float64)
    points = grid.index2world(index)
    h = float(grid.spacing_mm[0])
    rng = np.random.default_rng(seed)
    if noise_voxels > 0:
        points = points + rng.normal(0.0, noise_voxels * h, points.shape)
        keep = rng.random(len(points)) >= DROPPED
        points, confidence = points[keep], confidence[keep]
    return CenterPoints(
        points_mm=points,
        confidence=confidence,
        radius_mm=np.full(len(points), np.nan),
        spacing_mm=h,
        source="multi",
    )


def mode_options(refiner: RefinerName, centreline: bool) -> RefineOptions:
    """Options of one row; the paper's loss is half centreline where it has that part."""
    options = RefineOptions(refiner=refiner)
    share = 1.0 - options.paper.alpha if centreline else 0.0
    return dataclasses.replace(
        options,
        tube=dataclasses.replace(options.tube, centreline_share=share),
        paper=dataclasses.replace(options.paper, alpha=1.0 - share),
    )


def subject_of(case: Case) -> Subject:
    """Extract the vessels and work out what the measures need of the truth."""
    return Subject(
        case=case,
        views=[extract_vessels(a, RunOptions().imaging) for a in case.angiograms()],
        skeleton=skeleton(case.truth >= VOLUME_THRESHOLD, case.grid.spacing_mm),
        new_mm=case.new_projections(),
    )


def one_fit(subject: Subject, noise: float, mode: tuple[RefinerName, bool]) -> Row:
    """Refine one start in one mode and score it; seconds are process CPU seconds."""
    case, options = subject.case, mode_options(*mode)
    centers = start_points(case.truth, case.grid, noise, seed=0)
    begin = time.process_time()
    refined = refine(centers, subject.views, options)
    volume = refined_volume(refined, subject.views, case.grid, options)
    seconds = time.process_time() - begin
    return Row(
        protocol=case.protocol,
        case=case.name,
        refiner=mode[0],
        centreline=mode[1],
        noise=noise,
        measures=measured(subject, volume),
        cpu_s=seconds,
        settings=digest(mode),
    )


def measured(subject: Subject, volume: Volume) -> dict[str, float | None]:
    """Measures of one volume by the names of ``MEASURES``; new views are averaged."""
    case = subject.case
    found = skeleton(volume >= VOLUME_THRESHOLD, case.grid.spacing_mm)
    solid = as_label(np.clip(volume, 0, 1), case.grid)
    new = [
        projection_dice(truth_mm, raycast(solid, carm)).value
        for carm, truth_mm in zip(case.new_views, subject.new_mm, strict=True)
    ]
    defined = [value for value in new if value is not None]
    return {
        "dsc": volume_dice(case.truth, volume).value,
        "ot_1mm": overlap_within(subject.skeleton, found, 1.0).value,
        "new_dsc": float(np.mean(defined)) if defined else None,
    }


def digest(mode: tuple[RefinerName, bool]) -> str:
    """First letters of the SHA-256 of a mode's options: a row with another one is out of date."""
    text = json.dumps(dataclasses.asdict(mode_options(*mode)), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def refine_rows(
    data: Path,
    protocol: str,
    cases: Sequence[str],
    noises: Sequence[float],
    out: Path | None = None,
    on_fit: Callable[[], None] | None = None,
) -> list[Row]:
    """Fit every case from every start in every mode; rows that ``out`` has are read, not made."""
    rows = []
    for path in find_labels(data, cases):
        subject = None
        for mode in MODES:
            for noise in noises:
                file = out and out / f"{protocol}-{case_name(path)}-{_name(mode)}-{noise:g}.json"
                row = _kept(file, mode)
                if row is None:
                    subject = subject or subject_of(make_case(read_label(path), protocol))
                    row = one_fit(subject, noise, mode)
                    _keep(file, row)
                rows.append(row)
                if on_fit is not None:
                    on_fit()
    return rows


def table(rows: Sequence[Row], protocol: str) -> str:
    """Markdown, one table per measure: mean and SD per mode and start noise, and CPU seconds.

    Stars: Wilcoxon signed rank, paired by case, against the first mode.
    """
    own = [row for row in rows if row.protocol == protocol]
    noises = sorted({row.noise for row in own})
    heads = " | ".join(f"{noise:g} voxels" for noise in noises)
    parts = []
    for name, heading in MEASURES.items():
        lines = [
            f"| {protocol}: {heading} | centreline loss | {heads} | CPU s |",
            "|---|---|" + "---|" * len(noises) + "---|",
        ]
        for mode in MODES:
            cells = [_cell(own, mode, noise, name) for noise in noises]
            seconds = np.mean([row.cpu_s for row in own if (row.refiner, row.centreline) == mode])
            with_ = "with" if mode[1] else "without"
            lines.append(f"| {mode[0]} | {with_} | {' | '.join(cells)} | {seconds:.2f} |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def _cell(rows: Sequence[Row], mode: tuple[RefinerName, bool], noise: float, name: str) -> str:
    found = _by_case(rows, mode, noise, name)
    if not found:
        return "-"
    values = 100 * np.array(list(found.values()))
    spread = f" ± {values.std(ddof=1):.1f}" if len(values) > 1 else ""
    first = _by_case(rows, MODES[0], noise, name)
    pairs = [(value, first[case]) for case, value in found.items() if case in first]
    return f"{values.mean():.1f}{spread}" + (_stars(pairs) if mode != MODES[0] else "")


def _by_case(
    rows: Sequence[Row], mode: tuple[RefinerName, bool], noise: float, name: str
) -> dict[str, float]:
    return {
        row.case: value
        for row in rows
        if (row.refiner, row.centreline) == mode
        and row.noise == noise
        and (value := row.measures[name]) is not None
    }


def _stars(pairs: Sequence[tuple[float, float]]) -> str:
    from scipy.stats import wilcoxon

    difference = np.array([a - b for a, b in pairs])
    if not difference.any():
        return ""
    p = float(wilcoxon(difference).pvalue)
    return next((stars for level, stars in STARS if p < level), "")


def _name(mode: tuple[RefinerName, bool]) -> str:
    return mode[0] + ("-line" if mode[1] else "")


def _kept(file: Path | None, mode: tuple[RefinerName, bool]) -> Row | None:
    if file is None or not file.is_file():
        return None
    row = Row(**json.loads(file.read_text(encoding="utf-8")))
    return row if row.settings == digest(mode) else None


def _keep(file: Path | None, row: Row) -> None:
    """Write the row whole or not at all."""
    if file is None:
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(file) as partial:
        partial.write_text(json.dumps(dataclasses.asdict(row)), encoding="utf-8")
