"""A volume of one's own, made by whatever method, against the truth: the measures of the tables."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.measure.metrics import VOLUME_MEASURES, Measure, volume_measures
from gcar_deploy.types import Array, Volume
from gcar_export.evaluate.jobs import connected_parts
from gcar_export.evaluate.tables import MEASURES
from gcar_export.scenes.labels import EmptyLabelError, LabelVolume, read_label

#: lattices that are so much of a voxel apart are the same
SAME_LATTICE = 1e-3
#: a mean over windows of the whole volume, so it depends on how much of nothing is round the tree
_LEFT_OUT = ("ssim",)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Compared:
    """Two volumes on one lattice, and what they measure.

    Attributes
    ----------
    resampled : bool, the volume was brought onto the truth's lattice
    measures : by the names of ``evaluate.tables.MEASURES``
    """

    resampled: bool
    measures: Mapping[str, Measure]


def compare(volume: Path, truth: Path) -> Compared:
    """Measure a volume against the truth, both in one frame (mm of their files).

    Shares count as they are, of other values all above 0 is vessel. The lattice is the truth's; it
    reaches as far as either tree, so that nothing is cut off.

    Raises
    ------
    UsageError
        One cannot be read or is no label of vessels; the truth is empty; the two lie beside each
        other.
    """
    true = read_label(truth, shares=True).cropped()
    try:
        mine = read_label(volume, shares=True).cropped()
    except EmptyLabelError:
        # Whoever found nothing has no measures, and each says why.
        nothing = np.zeros_like(true.occupancy)
        return Compared(resampled=False, measures=_measures(true.occupancy, nothing, true))
    _refuse_apart(mine, true, volume, truth)
    spacing = np.asarray(true.grid.spacing_mm)
    before = _voxels(true.grid.lower_mm - mine.grid.lower_mm, spacing)
    after = _voxels(_upper(mine.grid) - _upper(true.grid), spacing)
    expected = np.pad(true.occupancy, list(zip(before, after, strict=True)))
    size = spacing * expected.shape
    x, y, z = expected.shape
    grid = Grid(
        center_mm=tuple((true.grid.lower_mm - before * spacing + 0.5 * size).tolist()),
        size_mm=tuple(size.tolist()),
        shape=(x, y, z),
    )
    found = _laid(mine, grid)
    resampled = found is None
    if found is None:
        found = mine.on_grid(grid)
    return Compared(resampled=resampled, measures=_measures(expected, found, true))


def _measures(expected: Volume, found: Volume, true: LabelVolume) -> dict[str, Measure]:
    names = [name for name in VOLUME_MEASURES if name not in _LEFT_OUT]
    measures = volume_measures(expected, found, np.asarray(true.grid.spacing_mm), names)
    return {**measures, "parts": connected_parts(found)}


def table(found: Compared) -> str:
    """Markdown of the measures, one a line."""
    lines = ["| measure | value |", "|---|---|"]
    for name, column in MEASURES.items():
        if name in found.measures:
            value, reason = found.measures[name]
            shown = f"- ({reason})" if value is None else f"{value * column.factor:.2f}"
            lines.append(f"| {column.heading} | {shown} |")
    if found.resampled:
        lines.append("\nThe volume was resampled onto the truth's voxels.")
    return "\n".join(lines)


def _laid(mine: LabelVolume, grid: Grid) -> Volume | None:
    """Lay a volume into a wider grid of the same lattice; None where it is of another one."""
    spacing = np.asarray(grid.spacing_mm)
    if np.abs(mine.grid.spacing_mm - spacing).max() > SAME_LATTICE * spacing.min():
        return None
    first = (mine.grid.lower_mm - grid.lower_mm) / spacing
    start = np.rint(first).astype(int)
    if np.abs(first - start).max() > SAME_LATTICE * max(grid.shape):
        return None
    rest = np.asarray(grid.shape) - start - mine.occupancy.shape
    return np.pad(mine.occupancy, list(zip(start, rest, strict=True)))


def _voxels(length_mm: Array, spacing_mm: Array) -> Array:
    """Whole voxels that cover these lengths, none where they are negative."""
    return np.maximum(np.ceil(length_mm / spacing_mm - SAME_LATTICE), 0).astype(int)


def _upper(grid: Grid) -> Array:
    return np.asarray(grid.lower_mm + np.asarray(grid.size_mm))


def _refuse_apart(mine: LabelVolume, true: LabelVolume, volume: Path, truth: Path) -> None:
    """Refuse trees whose boxes do not meet: they are of different frames."""
    (low, high), (from_mm, to_mm) = mine.box_mm(), true.box_mm()
    if (low > to_mm).any() or (from_mm > high).any():
        raise UsageError(
            f"{volume} lies at {_box(low, high)} and {truth} at {_box(from_mm, to_mm)} (mm LPS): "
            "they do not meet, and must be in one frame"
        )


def _box(low: Array, high: Array) -> str:
    return ", ".join(f"{a:.0f} .. {b:.0f}" for a, b in zip(low, high, strict=True))
