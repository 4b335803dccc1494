"""Closed lumen surface of a tree: the zero level of the signed distance to its tubes' union."""

from __future__ import annotations

import dataclasses
import struct

import numpy as np

from gcar_deploy.geometry.grid import Grid
from gcar_deploy.tree.occupancy import capsule_distance, near_pairs
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Points

#: lattice edge over the smallest radius, and its bounds, mm.
EDGE_PER_RADIUS = 0.6
EDGE_BOUNDS_MM = (0.25, 0.6)
#: the lattice is coarsened rather than hold more points than this.
MAX_POINTS = 40_000_000
#: coarsest lattice ever used, mm.
COARSEST_MM = 0.8
#: capsules handled at once.
CHUNK = 64


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """Triangles: (v, 3) vertices, mm LPS, and (f, 3) vertex numbers, normals outwards."""

    vertices_mm: Points
    faces: Array


def lumen_surface(tree: Tree, edge_mm: float | None = None) -> Surface:
    """Mesh the lumen by marching cubes on a local lattice.

    Parameters
    ----------
    tree : Tree
    edge_mm : float or None
        Lattice edge; None takes a share of the smallest radius, 0.25 .. 0.6 mm.

    Returns
    -------
    Surface, watertight; without a triangle if the tree has no branch
    """
    if not tree.branches:
        return Surface(vertices_mm=np.zeros((0, 3)), faces=np.zeros((0, 3), np.int64))
    from skimage.measure import marching_cubes

    lattice = lumen_lattice(tree, edge_mm)
    edge = float(lattice.spacing_mm[0])
    distance = lumen_distance(tree, lattice)
    # A vertex exactly on a lattice point would collapse triangles; nothing may be exactly 0.
    distance[np.abs(distance) < 1e-3 * edge] = 1e-3 * edge
    vertices, faces, _, _ = marching_cubes(
        distance, level=0.0, gradient_direction="descent", allow_degenerate=False
    )
    return Surface(vertices_mm=lattice.index2world(vertices), faces=faces.astype(np.int64))


def stl_bytes(surface: Surface, title: str = "lumen, mm, LPS") -> bytes:
    """Encode as binary STL."""
    corners = surface.vertices_mm[surface.faces].astype("<f4")
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.maximum(length, 1e-12)
    record = np.zeros(
        len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("pad", "<u2")]
    )
    record["normal"], record["corners"] = normals, corners
    header = title.encode("ascii", "replace")[:80].ljust(80, b" ")
    return header + struct.pack("<I", len(corners)) + record.tobytes()


def lumen_lattice(tree: Tree, edge_mm: float | None) -> Grid:
    """Lattice round a tree, as ``lumen_surface`` takes it."""
    radii = tree.radii()
    edge = edge_mm or float(np.clip(EDGE_PER_RADIUS * radii.min(), *EDGE_BOUNDS_MM))
    reach = float(radii.max()) + 2 * COARSEST_MM
    low, high = tree.points().min(axis=0) - reach, tree.points().max(axis=0) + reach
    while edge < COARSEST_MM and np.prod((high - low) / edge) > MAX_POINTS:
        edge = min(edge * 1.1, COARSEST_MM)
    shape = np.minimum(np.ceil((high - low) / edge).astype(int) + 1, 1024)
    size = shape * edge
    center = 0.5 * (low + high)
    return Grid(
        center_mm=(float(center[0]), float(center[1]), float(center[2])),
        size_mm=(float(size[0]), float(size[1]), float(size[2])),
        shape=(int(shape[0]), int(shape[1]), int(shape[2])),
    )


def lumen_distance(tree: Tree, lattice: Grid) -> Array:
    """(nx, ny, nz) float32 signed distance near the surface, mm; a constant further outside."""
    capsules = tree.segments()
    far = 2.0 * float(lattice.spacing_mm[0])
    out = np.full(int(np.prod(lattice.shape)), far, np.float32)
    for start in range(0, len(capsules[0]), CHUNK):
        part = tuple(x[start : start + CHUNK] for x in capsules)
        cell, capsule = near_pairs((part[0], part[1], part[2], part[3]), lattice, far)
        center = lattice.index2world(np.stack(np.unravel_index(cell, lattice.shape), axis=1))
        value = capsule_distance(center, (part[0], part[1], part[2], part[3]), capsule)
        np.minimum.at(out, cell, value.astype(np.float32))
    return out.reshape(lattice.shape)
