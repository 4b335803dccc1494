"""A tiny generated case: two views of a small tree, for warming up and for the self-test."""

from __future__ import annotations

import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.tree.tree import Branch, Tree
from gcar_deploy.tubes import footprint, tubes_of
from gcar_deploy.types import Points

#: pixels along each side of the pictures, and voxels along each edge of the grid
SIDE = 96
EDGE_MM = 96.0
_DIRECTIONS = ((-30.0, -20.0), (45.0, 25.0))


def tiny_tree() -> Tree:
    """Return a trunk that forks in two, some 130 mm long, radius 1.8 to 1 mm."""
    t = np.linspace(0.0, 1.0, 40)[:, None]
    fork = np.array([5.0, -4.0, 6.0])
    lines = (
        _arc(np.array([-8.0, 6.0, 30.0]), fork, np.array([4.0, 5.0, 0.0]), t),
        _arc(fork, np.array([28.0, -20.0, -24.0]), np.array([10.0, -2.0, 4.0]), t),
        _arc(fork, np.array([-20.0, 12.0, -30.0]), np.array([-4.0, 12.0, 3.0]), t),
    )
    nodes = np.array([lines[0][0], fork, lines[1][-1], lines[2][-1]])
    ends = ((0, 1), (1, 2), (1, 3))
    tapers = ((1.8, 1.6), (1.5, 1.0), (1.4, 1.0))
    branches = tuple(
        Branch(
            points_mm=line,
            radius_mm=np.linspace(*taper, len(line)),
            sigma_mm=np.full(len(line), np.nan),
            confidence=np.ones(len(line)),
            start=a,
            end=b,
        )
        for line, taper, (a, b) in zip(lines, tapers, ends, strict=True)
    )
    return Tree(nodes_mm=nodes, branches=branches)


def tiny_case() -> tuple[list[Angiogram], Grid, Tree]:
    """Return pictures (exact path lengths), the grid, and the tree that they show."""
    tree = tiny_tree()
    angiograms = []
    for number, (primary, secondary) in enumerate(_DIRECTIONS):
        carm = CArm(
            primary_angle_deg=primary, secondary_angle_deg=secondary, sod_mm=765.0, sdd_mm=1100.0,
            rows=SIDE, columns=SIDE, pixel_spacing_mm=(1.6, 1.6),
        )  # fmt: skip
        path = footprint(tubes_of(tree), carm, 1.0).image((SIDE, SIDE))
        angiograms.append(
            Angiogram(
                view_id=str(number + 1),
                carm=carm,
                pixels=np.rint(path * 1000).astype(np.float32),
                bit_depth=16,
                intensity=Intensity(kind="path_length", polarity="bright", mm_per_count=0.001),
                sha256="",
            )
        )
    shape = (SIDE, SIDE, SIDE)
    grid = Grid(center_mm=(0.0, 0.0, 0.0), size_mm=(EDGE_MM, EDGE_MM, EDGE_MM), shape=shape)
    return angiograms, grid, tree


def _arc(start: Points, stop: Points, bulge: Points, t: Points) -> Points:
    line: Points = start + t * (stop - start) + np.sin(np.pi * t) * bulge
    return line
