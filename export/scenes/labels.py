"""Coronary label volumes: read, split into left and right tree, area-average onto a grid.

Every reader ends in the same value, a ``LabelVolume`` whose axes run along patient LPS, so
that nothing downstream knows whether a tree came from ImageCAS (``*.label.nii.gz``), ASOCA
(``.nrrd``, or the released ``.npz``) or any other NIfTI, NRRD or MetaImage mask.
"""

from __future__ import annotations

import dataclasses
import re
import zipfile
import zlib
from pathlib import Path
from typing import Any

import click
import numpy as np
from nibabel.filebasedimages import ImageFileError
from nibabel.spatialimages import HeaderDataError
from scipy import ndimage

from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.types import Array, Points, Volume
from gcar_export.scenes.label_formats import read_metaimage, read_nrrd

#: voxel edge of the ASOCA case released as a bare 128^3 array: the paper's 180 mm cube.
ASOCA_NPZ_SPACING_MM = 180.0 / 128
#: an affine this far (relative) from axis-parallel is resampled instead of relabelled.
OBLIQUE_TOLERANCE = 1e-3
#: cosine of the angle between two axes of a file from which on they are sheared
SHEAR_TOLERANCE = 0.01
#: a volume with more vessel than the first share is no label of vessels; nor is one with more than
#: the second whose voxels have more values than any list of vessels
MOST_VESSEL, GREY_SHARE, GREY_VALUES = 0.9, 0.2, 100
#: empty voxels kept round the tree when a volume is cropped.
MARGIN_VOXELS = 2
#: a file is cropped on reading when the tree's box is a smaller share of it than this.
CROP_BELOW = 0.5
#: label trees whose box centre is this close to the isocentre are left where they are.
CENTRED_WITHIN_MM = 2.0
#: a part with a smaller share of the largest one's volume is a crumb and no tree of its own; the
#: smallest right artery met has 0.09
LEAST_TREE = 0.03
#: of a voxel that is vessel, or probability that it is, from which on it counts as vessel
SHARE = 0.5
#: samples along each edge of a voxel that is averaged over
SAMPLES = 3


class EmptyLabelError(UsageError):
    """A label volume without any vessel."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class LabelVolume:
    """Share of each voxel that is vessel, on a block of voxels parallel to LPS.

    Attributes
    ----------
    occupancy : (nx, ny, nz) float32, 0 .. 1
        0 and 1 only for a mask.
    grid : Grid
        Where those voxels are, mm LPS.
    name : str
        Case name, from the file.
    """

    occupancy: Volume
    grid: Grid
    name: str = "label"

    @property
    def volume_mm3(self) -> float:
        """Volume of the vessels, mm^3."""
        return float(self.occupancy.sum(dtype=np.float64) * np.prod(self.grid.spacing_mm))

    @property
    def affine(self) -> Array:
        """(4, 4) voxel index to mm RAS."""
        return self.grid.affine_ras()

    def box_mm(self) -> tuple[Points, Points]:
        """Return centres of the lowest and highest occupied voxels, (3,) mm LPS each."""
        low, high = _occupied_box(self.occupancy)
        return self.grid.index2world(low), self.grid.index2world(high)

    def cropped(self) -> LabelVolume:
        """Return the occupied box with a margin of ``MARGIN_VOXELS`` empty voxels."""
        low, high = _occupied_box(self.occupancy)
        low, high = low - MARGIN_VOXELS, high + 1 + MARGIN_VOXELS
        inner_low, inner_high = np.maximum(low, 0), np.minimum(high, self.occupancy.shape)
        core = self.occupancy[
            tuple(slice(a, b) for a, b in zip(inner_low, inner_high, strict=True))
        ]
        pad = list(zip(inner_low - low, high - inner_high, strict=True))
        return self._on(np.pad(core, pad), self.grid.lower_mm + low * self.grid.spacing_mm)

    def moved(self, shift_mm: Array) -> LabelVolume:
        """Return the same tree moved by (3,) mm LPS."""
        center = np.asarray(self.grid.center_mm) + np.asarray(shift_mm, dtype=np.float64)
        grid = dataclasses.replace(self.grid, center_mm=tuple(center.tolist()))
        return dataclasses.replace(self, grid=grid)

    def centred(self) -> LabelVolume:
        """Return the tree moved so that the middle of its occupied box is the isocentre."""
        low, high = self.box_mm()
        return self.moved(-0.5 * (low + high))

    def roughly_centred(self) -> LabelVolume:
        """Like ``centred``, but a tree within ``CENTRED_WITHIN_MM`` stays where it is."""
        low, high = self.box_mm()
        off = float(np.abs(0.5 * (low + high)).max())
        return self if off <= CENTRED_WITHIN_MM else self.centred()

    def components(self) -> list[LabelVolume]:
        """Return connected parts (26 neighbours, occupancy above 0), most voluminous first."""
        labels, count = ndimage.label(self.occupancy > 0, np.ones((3, 3, 3)))
        mass = ndimage.sum(self.occupancy, labels, np.arange(1, count + 1))
        parts = []
        for which in np.argsort(-mass, kind="stable") + 1:
            part = np.where(labels == which, self.occupancy, np.float32(0))
            parts.append(dataclasses.replace(self, occupancy=part))
        return parts

    def left_right(self) -> tuple[LabelVolume, LabelVolume]:
        """Split into the left and the right coronary tree.

        The two most voluminous connected parts are the two trees; the one whose centre of
        mass lies further to the patient's left is the left tree. Smaller parts (torn-off
        branches, crumbs) belong to neither.

        Raises
        ------
        UsageError
            If there are fewer than two parts, or the second has less than ``LEAST_TREE`` of the
            volume of the first.
        """
        parts = self.components()
        if len(parts) < 2:
            raise UsageError(f"{self.name}: one connected part only, no left and right tree")
        first, second = (float(part.occupancy.sum()) for part in parts[:2])
        if second < LEAST_TREE * first:
            raise UsageError(
                f"{self.name}: the second part has {second / first:.1%} of the first one's volume: "
                "a crumb, no tree"
            )
        x = [ndimage.center_of_mass(part.occupancy)[0] for part in parts[:2]]
        left, right = (parts[0], parts[1]) if x[0] > x[1] else (parts[1], parts[0])
        return left, right

    def on_grid(self, grid: Grid) -> Volume:
        """Area-averaged occupancy on another grid.

        Each voxel is the mean of ``SAMPLES``^3 evenly spaced trilinear samples of this volume
        (zero outside), or of more where samples would be further apart than its voxels. That
        is separable: one small matrix per axis. Identical grids are returned unchanged.

        Parameters
        ----------
        grid : Grid
            The voxels wanted.

        Returns
        -------
        (nx, ny, nz) float32 of ``grid.shape``, 0 .. 1
        """
        if grid == self.grid:
            return self.occupancy.astype(np.float32)
        out: Array = self.occupancy.astype(np.float64)
        ratio = grid.spacing_mm / self.grid.spacing_mm
        for axis in range(3):
            count = max(SAMPLES, int(np.ceil(ratio[axis])))
            weights = _axis_weights(self.grid, grid, axis, count)
            out = np.moveaxis(np.tensordot(weights, out, axes=(1, axis)), 0, axis)
        return np.clip(out, 0, 1).astype(np.float32)

    def _on(self, occupancy: Array, lower_mm: Array) -> LabelVolume:
        size = np.asarray(occupancy.shape) * self.grid.spacing_mm
        x, y, z = occupancy.shape
        grid = Grid(
            center_mm=tuple((lower_mm + 0.5 * size).tolist()),
            size_mm=tuple(size.tolist()),
            shape=(x, y, z),
        )
        return dataclasses.replace(self, occupancy=np.ascontiguousarray(occupancy), grid=grid)


#: what a file name has beside the name of the case
_SUFFIX = re.compile(r"(\.label)?\.(nii|nii\.gz|nrrd|nhdr|mha|mhd|npz)$", re.IGNORECASE)


def case_stem(path: Path) -> str:
    """Return a label file's name without its known suffixes; other dots belong to the name."""
    return _SUFFIX.sub("", path.name)


#: what a damaged file raises inside NumPy, nibabel, zlib and zipfile
_DAMAGE = (
    ValueError, OSError, EOFError, KeyError, MemoryError, OverflowError, ZeroDivisionError,
    np.linalg.LinAlgError, zlib.error, zipfile.BadZipFile, ImageFileError, HeaderDataError,
)  # fmt: skip


def read_label(path: str | Path, *, shares: bool = False) -> LabelVolume:
    """Read a label volume by its file name: .nii, .nii.gz, .nrrd, .mha, .mhd or ASOCA .npz.

    Any value above 0 is vessel. Shares (floating-point values, all within 0 .. 1, not only these
    two) are vessel from ``SHARE`` on, which is said on stderr; the ``occupancy`` array of an .npz
    (uint8, 0 .. 255) keeps its own, and so does every file with ``shares``. Wide empty borders are
    cropped.

    Raises
    ------
    UsageError
        If the file is missing, of another kind, or empty.
    """
    path = Path(path)
    if not path.is_file():
        raise UsageError(f"no such label volume: {path}")
    if not path.stat().st_size:
        raise UsageError(f"{path}: the file is empty")
    name = path.name.lower()
    case = case_stem(path)
    try:
        if name.endswith(".npz"):
            label = _read_npz(path, case)
        else:
            array, affine = _read_any(path, name)
            if array.ndim != 3:
                raise UsageError(f"{path}: a label volume has 3 axes, this has {array.ndim}")
            _refuse_sheared(affine, path)
            vessel = _vessel(array, path, said=not shares)
            _refuse_pictures(array, vessel, path)
            kept = shares and _holds_shares(array)
            label = from_array(array if kept else vessel, affine, case)
    except _DAMAGE as error:
        reason = (str(error).splitlines() or [""])[0].replace(str(path), "it")[:200]
        raise UsageError(f"{path}: cannot be read ({reason or type(error).__name__})") from None
    if not label.occupancy.any():
        raise EmptyLabelError(f"{path}: the label volume is empty")
    low, high = _occupied_box(label.occupancy)
    share = float(np.prod(high - low + 1)) / label.occupancy.size
    return label.cropped() if share < CROP_BELOW else label


def from_array(occupancy: Array, index2ras: Array, name: str = "label") -> LabelVolume:
    """Build from an array in any voxel order and its (4, 4) index to mm RAS.

    Axes are permuted and flipped to run along LPS; an oblique volume is resampled
    (trilinear) at its own finest spacing.
    """
    index2lps = np.diag([-1.0, -1.0, 1.0, 1.0]) @ np.asarray(index2ras, dtype=np.float64)
    array = np.asarray(occupancy, dtype=np.float32)
    if array.ndim != 3:
        raise UsageError(f"{name}: a label volume has 3 axes, this has {array.ndim}")
    directions = index2lps[:3, :3]
    spacing = np.linalg.norm(directions, axis=0)
    main = np.abs(directions / spacing).argmax(axis=0)
    off = np.abs(directions / spacing)
    off[main, np.arange(3)] = 0
    if sorted(main.tolist()) != [0, 1, 2] or off.max() > OBLIQUE_TOLERANCE:
        return _resampled(array, index2lps, name)
    order = np.argsort(main)
    array = np.transpose(array, order)
    corner = index2lps[:3, 3].copy()
    for world_axis, source_axis in enumerate(order):
        step = directions[world_axis, source_axis]
        if step < 0:
            array = np.flip(array, world_axis)
            corner[world_axis] += step * (array.shape[world_axis] - 1)
    spacing = spacing[order]
    size = spacing * array.shape
    center = corner - 0.5 * spacing + 0.5 * size
    x, y, z = array.shape
    grid = Grid(center_mm=tuple(center.tolist()), size_mm=tuple(size.tolist()), shape=(x, y, z))
    return LabelVolume(occupancy=np.ascontiguousarray(array), grid=grid, name=name)


def _refuse_sheared(index2ras: Array, path: Path) -> None:
    """Refuse axes that do not stand upright on each other: a tilted gantry, or a damaged header."""
    directions = np.asarray(index2ras, dtype=np.float64)[:3, :3]
    unit = directions / np.maximum(np.linalg.norm(directions, axis=0), 1e-12)
    cosine = float(np.abs(unit.T @ unit - np.eye(3)).max(initial=0.0, where=~np.eye(3, dtype=bool)))
    if cosine > SHEAR_TOLERANCE:
        raise UsageError(
            f"{path}: its axes are sheared, {np.degrees(np.arccos(min(cosine, 1.0))):.1f} deg "
            "apart, not 90; resample it on upright axes"
        )


def _refuse_pictures(array: Array, vessel: Array, path: Path) -> None:
    """Refuse what is vessel nearly everywhere, or a picture of grey values like a CT."""
    share = float(vessel.mean())
    grey = share > GREY_SHARE and len(np.unique(array)) > GREY_VALUES
    if share > MOST_VESSEL or grey:
        raise UsageError(
            f"{path}: {share:.0%} of its voxels are above 0, which is no label of vessels"
            + (": it holds grey values, as a CT does; label its vessels" if grey else "")
        )


def _vessel(array: Array, path: Path, *, said: bool) -> Array:
    """Voxels that are vessel, bool."""
    if np.issubdtype(array.dtype, np.floating):
        if strange := int((~np.isfinite(array)).sum()):
            raise UsageError(f"{path}: {strange} voxels are no finite numbers")
        if _holds_shares(array):
            if said:
                rule = f"from {SHARE} on a voxel is vessel"
                click.echo(f"{path} holds shares 0 .. 1: {rule}", err=True)
            return np.asarray(array >= SHARE)
    return np.asarray(array > 0)


def _holds_shares(array: Array) -> bool:
    """Whether the values are shares or probabilities: broken numbers, all within 0 .. 1."""
    within = np.issubdtype(array.dtype, np.floating) and array.min() >= 0 and array.max() <= 1
    return bool(within and ((array > 0) & (array < 1)).any())


def _read_any(path: Path, name: str) -> tuple[Array, Array]:
    if name.endswith((".nii", ".nii.gz")):
        import nibabel

        image: Any = nibabel.load(path)
        # Headers that name no unit mean mm.
        mm = {"meter": 1000.0, "micron": 0.001}.get(image.header.get_xyzt_units()[0], 1.0)
        return np.asarray(image.dataobj), np.diag([mm, mm, mm, 1.0]) @ np.asarray(image.affine)
    if name.endswith((".nrrd", ".nhdr")):
        return read_nrrd(path)
    if name.endswith((".mha", ".mhd")):
        return read_metaimage(path)
    raise UsageError(f"{path}: not a .nii, .nii.gz, .nrrd, .mha, .mhd or .npz label volume")


def _read_npz(path: Path, case: str) -> LabelVolume:
    """ASOCA Normal_1 as released with 3DGR-CAR: axes run right, to the front, down; 180 mm cube.

    The file does not say so. The other way round the ostia lie below their trees, and the left
    tree lies as a right one does (``quality.anatomy``).
    """
    with np.load(path, allow_pickle=False) as archive:
        if "occupancy" not in archive:
            raise UsageError(f"{path}: has no array named 'occupancy'")
        array = archive["occupancy"][::-1, ::-1, ::-1]
    if array.ndim != 3:
        raise UsageError(f"{path}: 'occupancy' must have 3 axes, has {array.ndim}")
    scale = 255.0 if array.dtype == np.uint8 else 1.0
    size = tuple(ASOCA_NPZ_SPACING_MM * n for n in array.shape)
    grid = Grid(center_mm=(0.0, 0.0, 0.0), size_mm=size, shape=tuple(array.shape))
    occupancy = (array / scale).astype(np.float32)
    return LabelVolume(occupancy=occupancy, grid=grid, name=f"asoca_{case}")


def _resampled(array: Array, index2lps: Array, name: str) -> LabelVolume:
    occupied = np.argwhere(array > 0)
    if not len(occupied):
        raise EmptyLabelError(f"{name}: the label volume is empty")
    step = float(np.linalg.norm(index2lps[:3, :3], axis=0).min())
    low, high = occupied.min(0) - 1, occupied.max(0) + 1
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    world = (low + corners * (high - low)) @ index2lps[:3, :3].T + index2lps[:3, 3]
    shape = np.ceil((world.max(0) - world.min(0)) / step).astype(int) + 1
    center = 0.5 * (world.max(0) + world.min(0))
    grid = Grid(
        center_mm=tuple(center.tolist()),
        size_mm=tuple((shape * step).tolist()),
        shape=tuple(shape.tolist()),
    )
    lps2index = np.linalg.inv(index2lps)
    matrix = lps2index[:3, :3] * grid.spacing_mm
    offset = lps2index[:3, :3] @ grid.index2world(np.zeros(3)) + lps2index[:3, 3]
    out = ndimage.affine_transform(array, matrix, offset, output_shape=grid.shape, order=1)
    return LabelVolume(occupancy=out, grid=grid, name=name)


def _axis_weights(source: Grid, target: Grid, axis: int, samples: int) -> Array:
    """(n_target, n_source) mean of linear interpolation over the samples of each voxel."""
    n_source, n_target = source.shape[axis], target.shape[axis]
    within = (np.arange(samples) + 0.5) / samples - 0.5
    index = np.arange(n_target)[:, None] + within
    world = target.lower_mm[axis] + (index + 0.5) * target.spacing_mm[axis]
    at = (world - source.lower_mm[axis]) / source.spacing_mm[axis] - 0.5
    weights = np.zeros((n_target, n_source))
    base = np.floor(at).astype(int)
    rows = np.broadcast_to(np.arange(n_target)[:, None], base.shape)
    for step, share in ((0, 1.0 - (at - base)), (1, at - base)):
        inside = (base + step >= 0) & (base + step < n_source)
        np.add.at(weights, (rows[inside], base[inside] + step), share[inside] / samples)
    return weights


def _occupied_box(occupancy: Array) -> tuple[Array, Array]:
    low, high = [], []
    for axis in range(3):
        others = tuple(a for a in range(3) if a != axis)
        hit = np.flatnonzero((occupancy > 0).any(axis=others))
        if not len(hit):
            raise EmptyLabelError("the label volume is empty")
        low.append(hit[0])
        high.append(hit[-1])
    return np.array(low), np.array(high)
