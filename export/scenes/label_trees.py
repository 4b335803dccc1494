"""Users' own label volumes as trees of capsules, to train on beside the generated ones.

A mask is thinned to its centreline, the distance to its surface is the radius, and neighbouring
centreline voxels are joined by capsules: the same points and radii that the generator gives, so
views, depth maps and occupancy come from one renderer for both kinds.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.measure.metrics import skeleton
from gcar_export.scenes.capsules import Capsules, LabelTree
from gcar_export.scenes.label_files import label_files
from gcar_export.scenes.labels import LabelVolume, read_label
from gcar_export.scenes.render import occupancy

#: label volumes are thinned at this voxel edge, mm
VOXEL_MM = 0.5
#: radii that the predictors are made for, mm
RADIUS_RANGE_MM = (0.4, 3.4)


def read_label_trees(folder: Path) -> tuple[list[LabelTree], dict[str, str]]:
    """Read every label volume of a folder, in the order of their names.

    Returns
    -------
    trees, and file name to SHA-256

    Raises
    ------
    UsageError
        None is there, or one cannot be read.
    """
    files = label_files(folder)
    trees = [_tree_of(file) for file in files]
    return trees, {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def _tree_of(file: Path) -> LabelTree:
    label = read_label(file)
    try:
        return label_tree(label)
    except UsageError as error:
        raise UsageError(f"{file}: {str(error).removeprefix(f'{label.name}: ')}") from None


def label_tree(label: LabelVolume) -> LabelTree:
    """Thin one label volume; each part is centred on its box.

    Raises
    ------
    UsageError
        The volume holds no vessel long enough for a capsule.
    """
    whole = capsules_of(label.centred())
    try:
        sides = tuple(capsules_of(side.centred()) for side in label.left_right())
    except UsageError:
        # One connected part, or a second one that is a crumb: no sides to tell apart.
        sides = ()
    return LabelTree(whole, sides)


def capsules_of(label: LabelVolume) -> Capsules:
    """Capsules along the centreline of one volume, in its own frame, mm LPS."""
    fine = _resampled(label)
    occupied = np.pad(fine.occupancy >= 0.5, 1)
    spacing = np.asarray(fine.grid.spacing_mm)
    index = skeleton(occupied, spacing).index
    if len(index) < 2:
        raise UsageError(f"{label.name}: no vessel is long enough to have a centreline")
    inside = ndimage.distance_transform_edt(occupied, sampling=spacing)
    # The thinned line may run beside the middle, and the distance is taken to the middle of the
    # first voxel outside, half an edge too far.
    inside = ndimage.maximum_filter(inside, size=3)
    radius = np.maximum(inside[tuple(index.T)] - 0.5 * VOXEL_MM, RADIUS_RANGE_MM[0])
    points = fine.grid.index2world(index - 1)
    pairs = cKDTree(points).query_pairs(1.01 * np.sqrt(3) * VOXEL_MM, output_type="ndarray")
    if not len(pairs):
        raise UsageError(f"{label.name}: no vessel is long enough to have a centreline")
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    a, b = pairs.T
    made = Capsules(points[a], points[b], 0.5 * (radius[a] + radius[b]))
    return _of_volume(made, fine)


def _of_volume(made: Capsules, fine: LabelVolume) -> Capsules:
    """Widen the inscribed tubes until they hold the label's volume: sections are never round."""
    near = ndimage.binary_dilation(fine.occupancy > 0, iterations=2)
    points = fine.grid.index2world(np.argwhere(near))
    wanted = float(fine.occupancy.sum())
    for _ in range(2):
        held, _, _ = occupancy(points, VOXEL_MM, made.starts, made.ends, made.radii, sub=2)
        factor = float(np.clip(np.sqrt(wanted / max(held.sum(), 1e-9)), 0.7, 1.5))
        made = Capsules(made.starts, made.ends, np.clip(made.radii * factor, *RADIUS_RANGE_MM))
    return made


def _resampled(label: LabelVolume) -> LabelVolume:
    """Put the volume on cubic voxels of ``VOXEL_MM``."""
    label = label.cropped()
    shape = np.maximum(np.ceil(np.asarray(label.grid.size_mm) / VOXEL_MM), 1).astype(int)
    size = shape * VOXEL_MM
    grid = Grid(
        center_mm=label.grid.center_mm,
        size_mm=(float(size[0]), float(size[1]), float(size[2])),
        shape=(int(shape[0]), int(shape[1]), int(shape[2])),
    )
    return LabelVolume(occupancy=label.on_grid(grid), grid=grid, name=label.name)
