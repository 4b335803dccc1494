"""One row of an evaluation: a case, a number of views, a method; made anywhere, kept as files.

``run_job`` needs nothing but the label file, so that it runs in another process or on another
machine; its outcome comes back as plain values and is written by whoever asked.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from gcar_deploy.errors import UsageError
from gcar_deploy.files import whole_file
from gcar_deploy.measure.metrics import (
    VOLUME_MEASURES,
    Measure,
    best_shifted_dice,
    projection_measures,
    volume_measures,
)
from gcar_deploy.types import Array, Volume
from gcar_export.methods.settings import MethodSettings
from gcar_export.methods.solve import Solved, solve
from gcar_export.scenes.labels import LabelVolume, case_stem, read_label
from gcar_export.scenes.protocols import COMMON, Case, make_case
from gcar_export.scenes.raycast import as_label, raycast
from gcar_export.scenes.thin_protocol import THIN, line_measures, thin_case

#: name that the truth's own pictures are kept under, beside the methods.
TRUTH = "truth"
#: status of a row without measures: its label is empty, or lacks a tree that the protocol shows
NO_CASE = "no case"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Job:
    """One row to be made.

    Attributes
    ----------
    label : label volume
    protocol, method, views : what to do with it
    digest : of the method's settings; a row with another one is out of date
    data : SHA-256 of the label file, likewise; None for a tree that is generated
    models : models of the user's own that it asks, in words
    """

    label: Path
    protocol: str
    method: str
    views: int
    digest: str
    data: str | None
    models: str = ""

    @property
    def case(self) -> str:
        """Name of the case, as ``read_label`` gives it."""
        return case_name(self.label)

    @property
    def name(self) -> str:
        """Stem of the row's files."""
        return f"{self.protocol}-{self.case}-{self.views}-{self.method}"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Done:
    """Outcome of a job: the row, and the tree from three sides.

    Attributes
    ----------
    row : plain values, as ``rows/*.json`` holds them
    sides, truth_sides : (rows, columns) uint8 from ``three_sides``; None without a volume, and of
        the truth where no case could be made of the label
    """

    row: dict[str, Any]
    sides: Array | None
    truth_sides: Array | None


def case_name(label: Path) -> str:
    """Name of the case a label file holds, as ``read_label`` gives it."""
    stem = case_stem(label)
    return f"asoca_{stem}" if label.suffix == ".npz" else stem


def run_job(job: Job, settings: MethodSettings) -> Done:
    """Make one row; of a label that no case can be made of one with the reason."""
    try:
        case = _case(job.label, job.data, job.protocol, job.views)
    except UsageError as error:
        return Done(row=_row(job, NO_CASE, str(error)), sides=None, truth_sides=None)
    solved = solve(case, job.method, settings)
    found = measure(case, solved)
    row = _row(job, solved.status, solved.sentence) | {
        "case": case.name,
        "measures": {name: m.value for name, m in found.items()},
        "reasons": {name: m.reason for name, m in found.items() if m.reason is not None},
        "gaussians": solved.gaussians,
        "seconds": float(solved.seconds["total"]),
        "cpu_seconds": float(solved.seconds["cpu"]),
        "stages": {s: float(t) for s, t in solved.seconds.items() if s not in ("total", "cpu")},
    }
    finite = solved.volume is not None and bool(np.isfinite(solved.volume).all())
    return Done(
        row=row,
        sides=three_sides(solved.volume) if finite and solved.volume is not None else None,
        truth_sides=three_sides(case.truth),
    )


def _row(job: Job, status: str, sentence: str) -> dict[str, Any]:
    """Return a row that nothing was measured for."""
    return {
        "protocol": job.protocol,
        "dataset": dataset(job.label),
        "case": job.case,
        "method": job.method,
        "views": job.views,
        "status": status,
        "sentence": sentence,
        "measures": {},
        "reasons": {},
        "gaussians": None,
        "seconds": None,
        "cpu_seconds": None,
        "stages": {},
        "settings": job.digest,
        "models": job.models,
        "label_sha256": job.data,
    }


def dataset(label: Path) -> str:
    """``ASOCA`` for files below a folder of that name, ``ImageCAS`` likewise, else ``labels``."""
    return {"asoca": "ASOCA", "imagecas": "ImageCAS"}.get(label.parent.name.lower(), "labels")


def measure(case: Case, solved: Solved) -> dict[str, Measure]:
    """All measures of one solved case, by the names of ``tables.MEASURES``.

    New projections are cast from the returned volume, clipped to 0 .. 1, and averaged over
    the case's new views (those on which the measure is defined). Where the patient moved between
    the views, DSC is also given for the best common shift, which no two views can see. The common
    protocol sums both directions of the Chamfer distance and counts connected components; of trees
    with a known centreline the shares found and true are told.
    """
    common = case.protocol in COMMON
    # SSIM is slow, and asked for where pictures are compared anyway.
    names = [name for name in VOLUME_MEASURES if case.new_views or name != "ssim"]
    found = volume_measures(case.truth, solved.volume, case.grid.spacing_mm, names)
    if case.protocol == "moved":
        found["shifted_dsc"] = best_shifted_dice(case.truth, solved.volume)
    if common:
        both = found["chamfer_mm"]
        found["cd_mm"] = Measure(None if both.value is None else 2 * both.value, both.reason)
        found["parts"] = connected_parts(solved.volume)
    if case.line_mm is not None:
        found |= line_measures(case.line_mm, solved.line_mm)
    if not case.new_views:
        return found
    per_view = []
    for carm, truth_mm in zip(case.new_views, case.new_projections(), strict=True):
        predicted = None
        if solved.volume is not None and np.isfinite(solved.volume).all():
            volume = as_label(np.clip(solved.volume, 0, 1), case.grid)
            predicted = raycast(volume, carm)
        per_view.append(projection_measures(truth_mm, predicted))
    for name in per_view[0]:
        found[f"new_{name}"] = _mean([view[name] for view in per_view])
    return found


def connected_parts(volume: Volume | None) -> Measure:
    """Count connected components (26 neighbours) at 0.5; undefined where there is nothing."""
    if volume is None:
        return Measure(None, "no prediction")
    count = int(ndimage.label(volume >= 0.5, np.ones((3, 3, 3)))[1])
    return Measure(float(count)) if count else Measure(None, "prediction is empty")


def three_sides(volume: Volume) -> Array:
    """Greatest occupancy along y, x and z, side by side: from the front, the left, above.

    Parameters
    ----------
    volume : (nx, ny, nz), 0 .. 1; x to the left, y to the back, z to the head

    Returns
    -------
    (max(nz, ny), nx + ny + nx) uint8, 255 for full; head and back upwards
    """
    shares = np.clip(volume, 0.0, 1.0)
    front, left = shares.max(axis=1).T[::-1], shares.max(axis=0).T[::-1]
    above = shares.max(axis=2).T[::-1]
    rows = max(front.shape[0], above.shape[0])
    sides = [np.pad(s, ((0, rows - s.shape[0]), (0, 0))) for s in (front, left, above)]
    return np.rint(255.0 * np.concatenate(sides, axis=1)).astype(np.uint8)


def row_path(out: Path, job: Job) -> Path:
    """Where the row of a job is kept."""
    return out / "rows" / f"{job.name}.json"


def sides_path(out: Path, protocol: str, case: str, views: int, method: str) -> Path:
    """Where the three sides of a row's tree are kept; those of the truth for every views."""
    views = 0 if method == TRUTH else views
    return out / "sides" / f"{protocol}-{case}-{views}-{method}.png"


def write_done(out: Path, job: Job, done: Done) -> None:
    """Write pictures first and the row last: a row that exists is whole."""
    import cv2

    for method, sides in ((job.method, done.sides), (TRUTH, done.truth_sides)):
        path = sides_path(out, job.protocol, job.case, job.views, method)
        if sides is None:
            path.unlink(missing_ok=True)
        else:
            _replace(path, cv2.imencode(".png", sides)[1].tobytes())
    text = json.dumps(done.row, indent=1, allow_nan=False)
    _replace(row_path(out, job), text.encode())


def _replace(path: Path, content: bytes) -> None:
    with whole_file(path) as partial:
        partial.write_bytes(content)


# A worker outlives an evaluation: what it keeps is tied to what is in the file.
@functools.lru_cache(maxsize=1)
def _label(path: Path, data: str | None) -> LabelVolume:
    return read_label(path)


@functools.lru_cache(maxsize=1)
def _case(path: Path, data: str | None, protocol: str, views: int) -> Case:
    if protocol in THIN:
        return thin_case(path.name, protocol, views)
    return make_case(_label(path, data), protocol, views)


def _mean(measures: Sequence[Measure]) -> Measure:
    values = [m.value for m in measures if m.value is not None]
    if values:
        return Measure(float(np.mean(values)))
    return Measure(None, measures[0].reason)
