"""How accuracy falls as the views come together, the geometry is wrong and masks are noisy.

Left trees of real label volumes, two 512 x 512 path-length views in clinical distances, the whole
reconstruction, one thing changed at a time:

============ ===== ========================================================================
curve        unit  what
============ ===== ========================================================================
separation   deg   views at primary +-half of it, secondary 0; everything exact
angle        deg   the second gantry was turned by so much, half primary, half secondary, and
                   the geometry does not say so
shift        mm    the patient moved by so much along (1, 1, 1) before the second view
mask         %     so many of the pixels at the vessels' rims are wrong, in patches
gaps         %     so many of the vessels' pixels are missing, in discs of 2 mm radius
============ ===== ========================================================================

All but the first take the clinical views (RAO 30 CAU 20, LAO 45 CRA 25). The volume counts at
the place where the tree truly is: no shift is allowed for.
"""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import json
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError, UsageError
from gcar_deploy.files import is_free, whole_file
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.measure.metrics import chamfer_mm, skeleton, volume_dice
from gcar_deploy.types import Array, Image
from gcar_export.evaluate.evaluate import find_labels
from gcar_export.scenes.labels import LabelVolume, case_stem, read_label
from gcar_export.scenes.protocols import MM_PER_COUNT
from gcar_export.scenes.raycast import raycast

CURVES: dict[str, tuple[float, ...]] = {
    "separation": (25, 35, 45, 60, 75, 90),
    "angle": (0, 1, 2, 3, 4, 5),
    "shift": (0, 2, 4, 6, 8, 10),
    "mask": (0, 10, 20, 30, 40, 50),
    "gaps": (0, 2, 5, 10, 20),
}
UNITS = {"separation": "deg", "angle": "deg", "shift": "mm", "mask": "%", "gaps": "%"}
#: radius of a gap, mm at the isocentre
GAP_MM = 2.0
FIELDS = ("curve", "level", "case", "status", "dsc", "chamfer_mm", "seconds", "settings")
_GRID = Grid(center_mm=(0, 0, 0), size_mm=(128, 128, 128), shape=(128, 128, 128))


@dataclasses.dataclass(frozen=True)
class Point:
    """One reconstruction to make: which curve, at which level."""

    curve: str
    level: float


def points(curves: Sequence[str]) -> Iterator[Point]:
    """Yield all levels of some curves.

    Raises
    ------
    UsageError
        An unknown curve.
    """
    for curve in curves:
        if curve not in CURVES:
            raise UsageError(f"curve {curve!r} is none of {', '.join(CURVES)}")
        yield from (Point(curve, float(level)) for level in CURVES[curve])


def examine(tree: LabelVolume, point: Point) -> list[Angiogram]:
    """Simulate the two pictures of a tree with their (perhaps wrong) geometry."""
    half = point.level / 2
    told = (
        [_view(-half, 0, 1100), _view(half, 0, 1060)]
        if point.curve == "separation"
        else [_view(-30, -20, 1100), _view(45, 25, 1060)]
    )
    true, moved, margin = list(told), tree, 0.0
    if point.curve == "angle":
        turn = point.level / np.sqrt(2)
        true[1] = told[1].turned(turn, turn)
    if point.curve == "shift":
        moved, margin = tree.moved(np.full(3, point.level / np.sqrt(3))), point.level
    paths = [raycast(tree, true[0]), raycast(moved, true[1], margin_mm=margin)]
    rng = np.random.default_rng(zlib.crc32(f"{tree.name} {point.level}".encode()))
    if point.curve == "mask":
        paths = [noisy_rim(path, point.level / 100, rng) for path in paths]
    if point.curve == "gaps":
        radius = round(GAP_MM / told[0].pixel_at_isocenter_mm)
        paths = [with_gaps(path, point.level / 100, radius, rng) for path in paths]
    return [_angiogram(str(k + 1), *pair) for k, pair in enumerate(zip(told, paths, strict=True))]


def noisy_rim(path_mm: Image, share: float, rng: np.random.Generator) -> Image:
    """Make a share of the pixels on both sides of the rims wrong, in patches of some pixels.

    Inside ones lose their path, outside ones get that of their neighbours.
    """
    mask = (path_mm > 0).astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    grown, shrunk = cv2.dilate(mask, kernel), cv2.erode(mask, kernel)
    rim = grown != shrunk
    field = cv2.GaussianBlur(rng.normal(size=mask.shape).astype(np.float32), (0, 0), 2.0)
    if share <= 0 or not rim.any():
        return path_mm
    wrong = rim & (field > np.quantile(field[rim], 1 - share))
    out = np.where(mask > 0, 0.0, cv2.dilate(path_mm, kernel))
    return np.where(wrong, out, path_mm).astype(np.float32)


def with_gaps(path_mm: Image, share: float, radius: int, rng: np.random.Generator) -> Image:
    """Erase discs of so many pixels' radius until a share of the vessel's pixels is gone."""
    out = path_mm.copy()
    rows, cols = np.nonzero(path_mm)
    for k in rng.permutation(len(rows)):
        if np.count_nonzero(out) <= (1 - share) * len(rows):
            break
        cv2.circle(out, (int(cols[k]), int(rows[k])), radius, 0.0, -1)
    return out


def run(
    data: Path,
    out: Path,
    *,
    cases: Sequence[str] = (),
    curves: Sequence[str] = tuple(CURVES),
    model: Path | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> list[dict[str, str]]:
    """Reconstruct what is missing from ``out``/robustness.csv; write it, a picture and a table.

    Raises
    ------
    UsageError
        No such case; rows of other settings (another model or version) are in ``out``, or
        something else.
    """
    if not (out / "robustness.csv").is_file() and not is_free(out, ("*.tmp",)):
        raise UsageError(f"{out} exists and holds no robustness.csv; give another --out")
    engine = Engine(model)
    settings = _settings(engine)
    files = find_labels(data, cases)
    out.mkdir(parents=True, exist_ok=True)
    rows = read_rows(out / "robustness.csv")
    if any(row["settings"] != settings for row in rows):
        raise UsageError(f"{out} holds rows of another model or version; give another --out")
    done = {(row["curve"], float(row["level"]), row["case"]) for row in rows}
    wanted = [(file, point) for file in files for point in points(curves)]
    tree: LabelVolume | None = None
    for n, (file, point) in enumerate(wanted):
        name = case_stem(file)
        if (point.curve, point.level, name) not in done:
            if tree is None or tree.name != name:
                label = read_label(file)
                tree = dataclasses.replace(label.left_right()[0].centred(), name=name)
            rows.append(_row(engine, tree, point) | {"case": name, "settings": settings})
            _write_rows(out / "robustness.csv", rows)
        if progress:
            progress(n + 1, len(wanted), f"{name} {point.curve} {point.level:g}")
    _write(out / "robustness.md", (table(rows) + "\n").encode())
    draw(rows, out / "robustness.png")
    return rows


def _row(engine: Engine, tree: LabelVolume, point: Point) -> dict[str, str]:
    row = {"curve": point.curve, "level": f"{point.level:g}", "status": "", "dsc": "",
           "chamfer_mm": "", "seconds": ""}  # fmt: skip
    try:
        result = engine.reconstruct(examine(tree, point), _GRID)
    except GcarError as error:
        return row | {"status": "refused" if error.exit_code == 6 else "failed"}
    truth = tree.on_grid(_GRID)
    lines = [skeleton(v >= 0.5, _GRID.spacing_mm) for v in (truth, result.volume)]
    dsc, chamfer = volume_dice(truth, result.volume).value, chamfer_mm(*lines).value
    return row | {
        "status": result.status,
        "dsc": "" if dsc is None else f"{dsc:.4f}",
        "chamfer_mm": "" if chamfer is None else f"{chamfer:.3f}",
        "seconds": f"{result.seconds['total']:.2f}",
    }


def table(rows: Sequence[dict[str, str]]) -> str:
    """Markdown: per curve one row per level, mean over cases."""
    out = []
    for curve in [c for c in CURVES if any(r["curve"] == c for r in rows)]:
        out += [
            f"| {curve}, {UNITS[curve]} | DSC(0.5) % | Chamfer mm | ok / degraded / refused |",
            "|---|---|---|---|",
        ]
        for level in sorted({float(r["level"]) for r in rows if r["curve"] == curve}):
            own = [r for r in rows if r["curve"] == curve and float(r["level"]) == level]
            count = [sum(r["status"] == s for r in own) for s in ("ok", "degraded", "refused")]
            out.append(
                f"| {level:g} | {_mean(own, 'dsc', 100)} | {_mean(own, 'chamfer_mm', 1)} "
                f"| {' / '.join(map(str, count))} |"
            )
        out.append("")
    return "\n".join(out).rstrip()


def _mean(rows: Sequence[dict[str, str]], key: str, scale: float) -> str:
    values = [scale * float(r[key]) for r in rows if r[key]]
    if not values:
        return "-"
    spread = np.std(values, ddof=1) if len(values) > 1 else 0.0
    return f"{np.mean(values):.2f} ± {spread:.2f} (n={len(values)})"


def draw(rows: Sequence[dict[str, str]], file: Path) -> None:
    """Draw one panel per curve: thin lines for cases, a thick one for their mean."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    curves = [c for c in CURVES if any(r["curve"] == c for r in rows)]
    figure = Figure(figsize=(3.2 * max(len(curves), 1), 2.9), layout="constrained")
    FigureCanvasAgg(figure)
    for k, curve in enumerate(curves):
        panel = figure.add_subplot(1, len(curves), k + 1)
        by_level: dict[float, list[float]] = {}
        for case in sorted({r["case"] for r in rows}):
            own = sorted(
                (float(r["level"]), 100 * float(r["dsc"]))
                for r in rows
                if r["curve"] == curve and r["case"] == case and r["dsc"]
            )
            panel.plot(*zip(*own, strict=True) if own else ([], []), color="0.7", linewidth=0.8)
            for level, value in own:
                by_level.setdefault(level, []).append(value)
        levels = sorted(by_level)
        panel.plot(levels, [np.mean(by_level[x]) for x in levels], color="C0", marker="o")
        panel.set_xlabel(f"{curve}, {UNITS[curve]}", fontsize=9)
        panel.set_ylim(0, 100)
        panel.tick_params(labelsize=7)
        if not k:
            panel.set_ylabel("volume DSC at 0.5, %", fontsize=9)
    with whole_file(file) as partial:
        figure.savefig(partial, dpi=120, format="png")


def read_rows(file: Path) -> list[dict[str, str]]:
    """Rows of an earlier run; none where there is no file.

    Raises
    ------
    UsageError
        Its columns are others.
    """
    if not file.is_file():
        return []
    with file.open(newline="", encoding="utf-8") as f:
        reader = csv.DictReader(f)
        if tuple(reader.fieldnames or ()) != FIELDS:
            raise UsageError(f"{file} is not that of this study; give another --out")
        return list(reader)


def _write_rows(file: Path, rows: Sequence[dict[str, str]]) -> None:
    with whole_file(file) as partial, partial.open("w", newline="", encoding="utf-8") as f:
        writer = csv.DictWriter(f, FIELDS)
        writer.writeheader()
        writer.writerows(rows)


def _write(file: Path, content: bytes) -> None:
    with whole_file(file) as partial:
        partial.write_bytes(content)


def _settings(engine: Engine) -> str:
    """Short hash of the model and of every option."""
    what: Any = [dict(engine.model or {}), dataclasses.asdict(engine.options)]
    return hashlib.sha256(json.dumps(what, sort_keys=True, default=str).encode()).hexdigest()[:12]


def _view(primary: float, secondary: float, sdd: float) -> CArm:
    return CArm(
        primary_angle_deg=primary, secondary_angle_deg=secondary, sod_mm=765, sdd_mm=sdd,
        rows=512, columns=512, pixel_spacing_mm=(0.39, 0.39),
    )  # fmt: skip


def _angiogram(name: str, carm: CArm, path_mm: Image) -> Angiogram:
    counts: Array = np.clip(np.rint(path_mm / MM_PER_COUNT), 0, 65535).astype(np.float32)
    return Angiogram(
        view_id=name,
        carm=carm,
        pixels=counts,
        bit_depth=16,
        intensity=Intensity(kind="path_length", polarity="bright", mm_per_count=MM_PER_COUNT),
        sha256=hashlib.sha256(counts.tobytes()).hexdigest(),
    )
