"""Fine ray caster over label volumes: path lengths in mm, and raw-looking X-ray pictures.

Independent of the runtime's Gaussian projector on purpose: it marches through the voxels
themselves, so simulated truth and reconstruction share nothing but ``CArm``.
"""

from __future__ import annotations

import numba
import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.types import Array, Image, Mask
from gcar_export.scenes.labels import LabelVolume

#: distance between samples along a ray, mm; and where only its outline is asked for
STEP_MM, OUTLINE_STEP_MM = 0.4, 0.1
#: occupancy of a vessel's surface
SURFACE = 0.5
#: edge of the blocks that are skipped when empty, voxels.
BLOCK = 8


def raycast(
    label: LabelVolume, carm: CArm, step_mm: float = STEP_MM, margin_mm: float = 0.0
) -> Image:
    """Length of vessel along the ray through each pixel centre.

    Trilinear samples every ``step_mm``, summed times ``step_mm``; zero outside the volume.
    Samples lie on shells round the source, counted from the one that touches the near side
    of a sphere round the isocentre with the volume's half diagonal as radius.

    Parameters
    ----------
    label : LabelVolume
        Occupancy 0 .. 1; need not be a mask, a reconstructed volume may be cast too.
    carm : CArm
        The view; the picture has its rows and columns.
    step_mm : float
        Distance between samples, mm.
    margin_mm : float
        Added to the sphere's radius, for a volume moved away from the isocentre.

    Returns
    -------
    (rows, columns) float32, mm
    """
    return _cast(label, carm, step_mm, margin_mm)


def silhouette(label: LabelVolume, carm: CArm) -> Mask:
    """Pixels whose central ray meets the surface of occupancy 0.5.

    Occupancy is trilinear between the voxels, so that a soft or coarse label's shadow is as wide
    as the vessel that it stands for.

    Parameters
    ----------
    label : LabelVolume
    carm : CArm

    Returns
    -------
    (rows, columns) bool
    """
    inside: Mask = _cast(label, carm, OUTLINE_STEP_MM, level=SURFACE) > 0
    return inside


def _cast(
    label: LabelVolume, carm: CArm, step_mm: float, margin_mm: float = 0.0, level: float = 0.0
) -> Image:
    """Sum of the samples times the step; with a ``level``, of those inside it, 1 for each."""
    occupancy = np.ascontiguousarray(label.occupancy, dtype=np.float32)
    if not occupancy.any():
        return np.zeros((carm.rows, carm.columns), np.float32)
    row0, row1, col0, col1 = _window(label, carm)
    out = np.zeros((carm.rows, carm.columns), np.float32)
    if row0 >= row1 or col0 >= col1:
        return out
    # A point at depth z along pixel (c, r) is source + z * inv(M) (c, r, 1): see CArm.
    inverse = np.linalg.inv(carm.world2pixel[:, :3])
    scale = 1.0 / label.grid.spacing_mm
    source = label.grid.world2index(carm.source_mm)
    out[row0:row1, col0:col1] = _march(
        occupancy,
        _filled_blocks(occupancy),
        source,
        inverse * scale[:, None],
        label.grid.spacing_mm,
        np.array([row0, row1, col0, col1]),
        np.array([_first_sample(label, carm) - margin_mm, step_mm, level]),
    )
    return out


def as_label(volume: Array, grid: Grid, name: str = "volume") -> LabelVolume:
    """Wrap a reconstructed volume (nx, ny, nz) on its grid so that it can be cast."""
    occupancy = np.ascontiguousarray(volume, dtype=np.float32)
    return LabelVolume(occupancy=occupancy, grid=grid, name=name)


def _first_sample(label: LabelVolume, carm: CArm) -> float:
    """Distance from the source to the first shell of samples, mm (may be negative)."""
    return float(np.linalg.norm(carm.source_mm) - 0.5 * np.linalg.norm(label.grid.size_mm))


def _window(label: LabelVolume, carm: CArm) -> tuple[int, int, int, int]:
    """Rows and columns (half open) that can see the occupied box."""
    low, high = label.box_mm()
    pad = label.grid.spacing_mm
    low, high = low - pad, high + pad
    corners = np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    pixels, depth = carm.project(corners)
    if (depth <= 0).any():
        return 0, carm.rows, 0, carm.columns
    first = np.floor(pixels.min(0)).astype(int)
    last = np.ceil(pixels.max(0)).astype(int) + 1
    return (
        max(first[1], 0),
        min(last[1], carm.rows),
        max(first[0], 0),
        min(last[0], carm.columns),
    )


def _filled_blocks(occupancy: Array) -> Array:
    """Tell which blocks of ``BLOCK``^3 voxels a trilinear sample could be non-zero in, bool."""
    shape = tuple(-(-n // BLOCK) for n in occupancy.shape)
    padded = np.zeros(tuple(n * BLOCK for n in shape), np.bool_)
    x, y, z = occupancy.shape
    padded[:x, :y, :z] = occupancy > 0
    # A sample with base index i reads voxels i and i + 1.
    for axis in range(3):
        ahead = np.roll(padded, -1, axis)
        np.moveaxis(ahead, axis, 0)[-1] = False
        padded = padded | ahead
    blocks = padded.reshape(shape[0], BLOCK, shape[1], BLOCK, shape[2], BLOCK)
    return np.ascontiguousarray(blocks.any(axis=(1, 3, 5)))


@numba.njit(cache=True, fastmath=False)
def _march(occupancy, blocks, source, pixel2index, spacing, window, start_step):  # type: ignore[no-untyped-def]
    """Sum samples along the ray of each pixel of the window, in voxel indices."""
    nx, ny, nz = occupancy.shape
    limits = np.array([nx, ny, nz])
    row0, row1, col0, col1 = window
    start, step, level = start_step
    out = np.zeros((row1 - row0, col1 - col0), np.float32)
    ray = np.empty(3)
    for row in range(row0, row1):
        for col in range(col0, col1):
            length = 0.0
            for k in range(3):
                ray[k] = pixel2index[k, 0] * col + pixel2index[k, 1] * row + pixel2index[k, 2]
                length += (ray[k] * spacing[k]) ** 2
            length = np.sqrt(length)
            near, far = 0.0, 1e30
            for k in range(3):
                ray[k] = ray[k] / length  # voxels per mm
                if abs(ray[k]) > 1e-12:
                    a = (-1.0 - source[k]) / ray[k]
                    b = (limits[k] - source[k]) / ray[k]
                    near = max(near, min(a, b))
                    far = min(far, max(a, b))
                elif source[k] <= -1.0 or source[k] >= limits[k]:
                    far = -1.0
            if far <= near:
                continue
            total = 0.0
            j = int(np.ceil((near - start) / step))
            stop = (far - start) / step
            while j <= stop:
                t = start + j * step
                x = source[0] + t * ray[0]
                y = source[1] + t * ray[1]
                z = source[2] + t * ray[2]
                i0 = int(np.floor(x))
                i1 = int(np.floor(y))
                i2 = int(np.floor(z))
                j += 1
                if i0 < -1 or i1 < -1 or i2 < -1 or i0 >= nx or i1 >= ny or i2 >= nz:
                    continue
                if i0 >= 0 and i1 >= 0 and i2 >= 0:  # noqa: SIM102
                    if not blocks[i0 // BLOCK, i1 // BLOCK, i2 // BLOCK]:
                        continue
                fx, fy, fz = x - i0, y - i1, z - i2
                value = 0.0
                for dx in range(2):
                    px = i0 + dx
                    if px < 0 or px >= nx:
                        continue
                    wx = fx if dx else 1.0 - fx
                    for dy in range(2):
                        py = i1 + dy
                        if py < 0 or py >= ny:
                            continue
                        wy = wx * (fy if dy else 1.0 - fy)
                        for dz in range(2):
                            pz = i2 + dz
                            if pz < 0 or pz >= nz:
                                continue
                            value += wy * (fz if dz else 1.0 - fz) * occupancy[px, py, pz]
                if level <= 0.0:
                    total += value
                elif value >= level:
                    total += 1.0
            out[row - row0, col - col0] = total * step
    return out
