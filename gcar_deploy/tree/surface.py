"""Closed lumen surface of a tree: the zero level of the signed distance to its tubes' union.

Only blocks of the lattice that the tubes touch are ever filled: a tree is less than a hundredth of
the box round it.
"""

from __future__ import annotations

import dataclasses
import itertools
import struct
from collections.abc import Iterator

import numpy as np

from gcar_deploy.geometry.grid import Grid
from gcar_deploy.tree.occupancy import near_pairs
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Points

#: lattice edge over the smallest radius, and its bounds, mm.
EDGE_PER_RADIUS = 0.6
EDGE_BOUNDS_MM = (0.25, 0.6)
#: the lattice is coarsened rather than hold more points than this.
MAX_POINTS = 40_000_000
#: coarsest lattice ever used, mm.
COARSEST_MM = 0.8
#: lattice points along the edge of a block
BLOCK = 24
#: distances are exact to so far outside, lattice edges
FAR = 2.0
#: the block with the first of its neighbours' points: neighbour, where to, and of what of it
_PARTS = tuple(
    (
        np.array(beyond),
        tuple(slice(BLOCK, None) if d else slice(BLOCK) for d in beyond),
        tuple(slice(1) if d else slice(None) for d in beyond),
    )
    for beyond in itertools.product((0, 1), repeat=3)
)


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
    vertices, faces, total = [], [], 0
    for origin, distance in _blocks(tree, lattice):
        own, triangles, _, _ = marching_cubes(distance, level=0.0, gradient_direction="descent")
        vertices.append(own + origin)
        faces.append(triangles + np.int64(total))
        total += len(own)
    if not vertices:
        return Surface(vertices_mm=np.zeros((0, 3)), faces=np.zeros((0, 3), np.int64))
    index, of = _merged(np.concatenate(vertices), lattice.shape)
    return Surface(vertices_mm=lattice.index2world(index), faces=of[np.concatenate(faces)])


def _blocks(tree: Tree, lattice: Grid) -> Iterator[tuple[Array, Array]]:
    """Yield first lattice index (3,) and distance (BLOCK + 1,) * 3 of what the surface crosses.

    Blocks share the points of their common planes.
    """
    number = np.full(-(-np.array(lattice.shape) // BLOCK) + 1, -1)
    cell, value = _near(tree, lattice)
    # Places among all blocks, each block's in a row, by tables: nothing is divided twice.
    size, steps = BLOCK**3, (number.shape[1] * number.shape[2], number.shape[2], 1)
    along = [
        np.arange(n) // BLOCK * (steps[axis] * size) + np.arange(n) % BLOCK * BLOCK ** (2 - axis)
        for axis, n in enumerate(lattice.shape)
    ]
    column, z = np.divmod(cell, lattice.shape[2])
    place = np.add.outer(along[0], along[1]).reshape(-1)[column] + along[2][z]
    block = place // size
    flat = number.reshape(-1)
    flat[block] = 0
    occupied = np.argwhere(number == 0)
    number[tuple(occupied.T)] = np.arange(len(occupied))
    edge = float(lattice.spacing_mm[0])
    # One more, which number -1 finds: no vessel.
    tiles = np.full((len(occupied) + 1, BLOCK, BLOCK, BLOCK), FAR * edge, np.float32)
    place += ((flat - np.arange(len(flat))) * size)[block]
    np.minimum.at(tiles.reshape(-1), place, value)
    # A vertex exactly on a lattice point would collapse triangles; nothing may be exactly 0. So
    # marching cubes need not look for any.
    tiles[np.abs(tiles) < 1e-3 * edge] = 1e-3 * edge
    for corner in occupied:
        distance = np.empty((BLOCK + 1,) * 3, np.float32)
        for beyond, to, of in _PARTS:
            distance[to] = tiles[number[tuple(corner + beyond)]][of]
        if distance.min() < 0 < distance.max():
            yield BLOCK * corner, distance


def _merged(vertices: Array, shape: tuple[int, int, int]) -> tuple[Array, Array]:
    """Make one of vertices that several blocks share; they are equal to the last bit.

    Returns
    -------
    (m, 3) vertices, and (v,) which of them each of the given is
    """
    low = np.floor(vertices).astype(np.int64)
    between = vertices > low
    # Off the shared planes, and within a cell, a vertex is alone.
    shared = ((low % BLOCK == 0) & ~between).any(axis=1)
    edge = np.ravel_multi_index(tuple(low[shared].T), shape) * 3 + between[shared].argmax(axis=1)
    _, first, inverse = np.unique(edge, return_index=True, return_inverse=True)
    own = np.flatnonzero(~shared)
    of = np.empty(len(vertices), np.int64)
    of[own] = np.arange(len(own))
    of[shared] = len(own) + inverse
    return vertices[np.concatenate([own, np.flatnonzero(shared)[first]])], of


def stl_bytes(surface: Surface) -> bytes:
    """Encode as binary STL."""
    corners = surface.vertices_mm[surface.faces].astype("<f4")
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.maximum(length, 1e-12)
    record = np.zeros(
        len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("pad", "<u2")]
    )
    record["normal"], record["corners"] = normals, corners
    header = b"lumen, mm, LPS".ljust(80)
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
    out = np.full(int(np.prod(lattice.shape)), FAR * float(lattice.spacing_mm[0]), np.float32)
    np.minimum.at(out, *_near(tree, lattice))
    return out.reshape(lattice.shape)


def _near(tree: Tree, lattice: Grid) -> tuple[Array, Array]:
    """Flat lattice indices near each capsule, and the distance from it, mm."""
    cell, _, distance = near_pairs(tree.segments(), lattice, FAR * float(lattice.spacing_mm[0]))
    return cell, distance.astype(np.float32)
