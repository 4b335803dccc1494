"""Score ready cases through the command line: ``gcar run`` as a user would call it.

A ready case is a folder with ``view1.png`` ..., ``geom.json`` and ``truth.nii.gz``: the share of
each voxel that is vessel, 0 .. 1. The command runs in a process of its own; only its exit code and
``volume.nii.gz`` are looked at.
"""

from __future__ import annotations

import dataclasses
import json
import re
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
from nibabel.filebasedimages import ImageFileError
from nibabel.spatialimages import HeaderDataError

from gcar_deploy.errors import UsageError
from gcar_deploy.measure.metrics import Measure, best_dice, best_shifted_dice, volume_dice
from gcar_deploy.types import Array

#: what means are given of, in the order of the table
_MEANS = ("dsc", "shifted_dsc", "best_dsc")
#: how far (mm) the affine of a volume may be off the truth's.
AFFINE_TOLERANCE_MM = 1e-3


@dataclasses.dataclass(frozen=True, kw_only=True)
class Score:
    """Outcome of one ready case.

    Attributes
    ----------
    case : folder name
    exit_code : of ``gcar run``; None if it was stopped after the time limit
    seconds : wall-clock time of the command, its start included
    status : from ``result.json``; empty if there is none
    dsc : volume DSC at 0.5
    shifted_dsc : the best over common shifts up to 3 voxels, which no two views can see
    best_dsc : best over thresholds, without shifts
    message : last line on stderr if the command failed
    """

    case: str
    exit_code: int | None
    seconds: float
    status: str
    dsc: Measure
    shifted_dsc: Measure
    best_dsc: Measure
    message: str = ""


def score_case(folder: Path, extra: Sequence[str] = (), limit_s: float = 600.0) -> Score:
    """Run ``gcar run`` on a ready case, with ``extra`` options, and score its volume.

    Raises
    ------
    UsageError
        If the folder is not a ready case, or its truth holds other values than 0 .. 1.
    """
    pictures = sorted(folder.glob("view*.png"), key=_number)
    if not pictures or not (folder / "truth.nii.gz").is_file():
        raise UsageError(f"{folder}: not a ready case (view*.png, geom.json, truth.nii.gz)")
    truth, affine = _truth(folder / "truth.nii.gz")
    with tempfile.TemporaryDirectory(prefix="gcar-score-") as scratch:
        out = Path(scratch) / "result"
        command = [sys.executable, "-m", "gcar_deploy.cli.main", "run"]
        command += [*map(str, pictures), "--geom", str(folder / "geom.json")]
        command += ["--out", str(out), *extra]
        start = time.perf_counter()
        try:
            done = subprocess.run(  # noqa: S603 - our own command, no shell
                command, capture_output=True, text=True, timeout=limit_s, check=False
            )
        except subprocess.TimeoutExpired:
            none = Measure(None, f"stopped after {limit_s:g} s")
            return Score(
                case=folder.name, exit_code=None, seconds=limit_s, status="", dsc=none,
                shifted_dsc=none, best_dsc=none,
            )  # fmt: skip
        seconds = time.perf_counter() - start
        predicted, status = _read(folder, out, truth, affine)
    return Score(
        case=folder.name,
        exit_code=done.returncode,
        seconds=seconds,
        status=status,
        dsc=volume_dice(truth, predicted),
        shifted_dsc=best_shifted_dice(truth, predicted),
        best_dsc=best_dice(truth, predicted)[0],
        message=(done.stderr.strip().splitlines() or [""])[-1] if done.returncode else "",
    )


def table(scores: Sequence[Score]) -> str:
    """Markdown table of the scores, with a mean of the cases whose names begin alike."""
    heads = ["case", "exit", "status", "DSC %", "DSC, common shift allowed %", "best DSC %", "s"]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for s in scores:
        lines.append(
            f"| {s.case} | {s.exit_code} | {s.status or s.message} | {_percent(s.dsc)} "
            f"| {_percent(s.shifted_dsc)} | {_percent(s.best_dsc)} | {s.seconds:.2f} |"
        )
    kinds = dict.fromkeys(s.case.split("_")[0] for s in scores)
    for kind in kinds:
        group = [s for s in scores if s.case.split("_")[0] == kind]
        means = [_mean([getattr(s, name) for s in group]) for name in _MEANS]
        seconds = float(np.mean([s.seconds for s in group]))
        lines.append(
            f"| mean of {kind}_* ({len(group)} cases) | | | {' | '.join(means)} | {seconds:.2f} |"
        )
    return "\n".join(lines) + "\n"


def _mean(measures: Sequence[Measure]) -> str:
    """Return the mean in percent, with how many it is of where that is not all."""
    defined = [m.value for m in measures if m.value is not None]
    if not defined:
        return "-"
    count = "" if len(defined) == len(measures) else f" (n={len(defined)})"
    return f"{100 * float(np.mean(defined)):.2f}{count}"


def _truth(path: Path) -> tuple[Array, Array]:
    """Return occupancy, 0 .. 1, and the (4, 4) affine, mm RAS."""
    try:
        image: Any = nibabel.load(path)
        truth = np.asarray(image.dataobj)
    except (ImageFileError, HeaderDataError, OSError, EOFError, ValueError, zlib.error) as error:
        reason = (str(error).splitlines() or [""])[0][:200]
        raise UsageError(f"{path}: cannot be read ({reason})") from None
    # Not "outside": a comparison with NaN is false.
    if not (truth.min() >= 0 and truth.max() <= 1):
        raise UsageError(
            f"{path}: values {truth.min():g} .. {truth.max():g} are not 0 .. 1 (share of vessel)"
        )
    return truth, image.affine


def _read(folder: Path, out: Path, truth: Array, affine: Array) -> tuple[Array | None, str]:
    if not (out / "volume.nii.gz").is_file():
        return None, ""
    found: Any = nibabel.load(out / "volume.nii.gz")
    predicted = np.asarray(found.dataobj)
    same = predicted.shape == truth.shape
    if not same or np.abs(found.affine - affine).max() > AFFINE_TOLERANCE_MM:
        raise UsageError(f"{folder.name}: the volume is not on the truth's grid")
    status = json.loads((out / "result.json").read_text()).get("status", "")
    return predicted, status


def _percent(measure: Measure) -> str:
    return f"- ({measure.reason})" if measure.value is None else f"{100 * measure.value:.2f}"


def _number(path: Path) -> int:
    digits = re.findall(r"\d+", path.stem)
    return int(digits[-1]) if digits else 0
