"""Small generated label volumes as files, for tests of the evaluation."""

from __future__ import annotations

from pathlib import Path

import nibabel
import numpy as np
from scipy import ndimage

from gcar_deploy.geometry.grid import Grid
from gcar_export.scenes.render import occupancy
from gcar_export.scenes.trees import random_tree

#: trees are shrunk to this share, so that they are quickly done.
SHRUNK = 0.6
EDGE_MM = 0.7


def write_tree(path: Path, seed: int) -> None:
    """Write a left tree of the generator, shrunk, as a NIfTI mask of 0.7 mm voxels."""
    tree = random_tree(np.random.default_rng(seed)).sides("left")
    starts, ends, radii = tree.segments()
    starts, ends = starts * SHRUNK, ends * SHRUNK
    size = 2 * np.abs(np.concatenate([starts, ends])).max() + 12
    n = int(np.ceil(size / EDGE_MM))
    grid = Grid(center_mm=(0, 0, 0), size_mm=(n * EDGE_MM,) * 3, shape=(n,) * 3)
    near = np.zeros(grid.shape, bool)
    near[tuple(np.rint(grid.world2index(0.5 * (starts + ends))).astype(int).T)] = True
    near = ndimage.binary_dilation(near, np.ones((3, 3, 3)), iterations=5)
    share = occupancy(grid.index2world(np.argwhere(near)), EDGE_MM, starts, ends, radii)[0]
    volume = np.zeros(grid.shape, np.uint8)
    volume[near] = share >= 0.5
    path.parent.mkdir(parents=True, exist_ok=True)
    nibabel.save(nibabel.Nifti1Image(volume, grid.affine_ras()), path)
