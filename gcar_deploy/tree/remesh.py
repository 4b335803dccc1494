"""Lumen surface of even triangles, for programs that mesh its inside.

Marching cubes leaves slivers wherever a corner of the lattice lies near the surface. Vertices
near a corner are merged there (after Raman and Wenger, Computer Graphics Forum 27:791, 2008), the
rest is evened out along the surface and drawn back onto it. A merge that would leave an edge with
other than two triangles, or a vertex with more than one fan, is taken back.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.ndimage import map_coordinates
from scipy.sparse import csgraph

from gcar_deploy.tree.surface import Surface, lumen_distance, lumen_lattice
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Points

#: a vertex so near to a corner of the lattice is merged with the others there, edges
MERGE_SHARE = 0.35
#: rounds of evening out, and how far each goes towards the mean of the neighbours
_ROUNDS, _STEP = 8, 0.5
_MOST_REPAIRS = 40


def even_surface(tree: Tree, edge_mm: float | None = None) -> tuple[Surface, float]:
    """Mesh the lumen with even triangles; see the head of this file.

    Parameters
    ----------
    tree : Tree with a branch
    edge_mm : lattice edge; None takes that of ``lumen_surface``

    Returns
    -------
    surface : Surface, closed, every edge between two triangles
    edge_mm : the lattice edge that was used
    """
    from skimage.measure import marching_cubes

    lattice = lumen_lattice(tree, edge_mm)
    edge = float(lattice.spacing_mm[0])
    distance = lumen_distance(tree, lattice)
    distance[np.abs(distance) < 1e-3 * edge] = 1e-3 * edge
    vertices, faces, _, _ = marching_cubes(
        distance, level=0.0, gradient_direction="descent", allow_degenerate=False
    )
    vertices, faces = _merged(vertices.astype(float), faces.astype(np.int64))
    vertices = _evened(vertices, faces, distance)
    return Surface(vertices_mm=lattice.index2world(vertices), faces=faces), edge


def _merged(vertices: Points, faces: Array) -> tuple[Points, Array]:
    """Merge vertices near the same corner of the lattice, in units of its edge."""
    corner = np.rint(vertices).astype(np.int64)
    near = np.abs(vertices - corner).max(axis=1) < MERGE_SHARE
    _, place = np.unique(corner, axis=0, return_inverse=True)
    place = place.reshape(-1)
    n = len(vertices)
    for _ in range(_MOST_REPAIRS):
        group = np.where(near, n + place, np.arange(n))
        _, label = np.unique(group, return_inverse=True)
        label = label.reshape(-1)
        merged = label[faces]
        kept = merged[(merged != np.roll(merged, 1, axis=1)).all(axis=1)]
        bad = improper(kept)
        if not len(bad):
            break
        # The corners round the fault stay as they are.
        round_it = np.isin(merged, bad).any(axis=1)
        near &= ~np.isin(place, place[np.unique(faces[round_it])])
    count = np.bincount(label)
    mean = np.stack([np.bincount(label, column) / count for column in vertices.T], axis=1)
    used, renumbered = np.unique(kept, return_inverse=True)
    return mean[used], renumbered.reshape(kept.shape)


def improper(faces: Array) -> Array:
    """Vertices on an edge that has not two triangles, one each way, or with more than one fan."""
    if not len(faces):
        return np.zeros(0, np.int64)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    n = int(faces.max()) + 1
    there = edges[:, 0] * n + edges[:, 1]
    back = edges[:, 1] * n + edges[:, 0]
    values, count = np.unique(there, return_counts=True)
    wrong = np.isin(there, values[count > 1]) | ~np.isin(back, values)
    return np.unique(np.concatenate([edges[wrong].ravel(), _pinched(faces)]))


def _pinched(faces: Array) -> Array:
    """Vertices whose triangles are more than one fan."""
    m = len(faces)
    corner = np.arange(3 * m).reshape(m, 3)
    # Corners of neighbouring triangles at the same vertex belong to one fan.
    a = np.concatenate([faces[:, k] for k in range(3)])
    b = np.concatenate([faces[:, (k + 1) % 3] for k in range(3)])
    ca = np.concatenate([corner[:, k] for k in range(3)])
    cb = np.concatenate([corner[:, (k + 1) % 3] for k in range(3)])
    n = int(faces.max()) + 1
    low, high = np.minimum(a, b), np.maximum(a, b)
    order = np.argsort(low * n + high, kind="stable")
    key = (low * n + high)[order]
    same = np.flatnonzero(key[1:] == key[:-1])
    first, second = order[same], order[same + 1]
    swap = a[first] != a[second]
    at_a = np.where(swap, cb[second], ca[second])
    at_b = np.where(swap, ca[second], cb[second])
    rows, columns = np.concatenate([ca[first], cb[first]]), np.concatenate([at_a, at_b])
    links = sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(3 * m, 3 * m))
    _, fan = csgraph.connected_components(links, directed=False)
    pairs = np.unique(np.stack([faces.reshape(-1), fan]), axis=1)
    vertex, fans = np.unique(pairs[0], return_counts=True)
    out: Array = vertex[fans > 1]
    return out


def _evened(vertices: Points, faces: Array, distance: Array) -> Points:
    """Move vertices to the middle of their neighbours, and back onto the surface."""
    n = len(vertices)
    i = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    beside = sparse.csr_matrix((np.ones(len(i)), (i[:, 0], i[:, 1])), shape=(n, n))
    degree = np.asarray(beside.sum(axis=1)).reshape(-1, 1)
    for _ in range(_ROUNDS):
        moved = vertices + _STEP * (beside @ vertices / degree - vertices)
        vertices = _drawn_back(moved, distance)
    return vertices


def _drawn_back(points: Points, distance: Array) -> Points:
    """Two Newton steps to the zero of a lattice of distances, in units of its edge."""

    def read(at: Points) -> Array:
        out: Array = map_coordinates(distance, at.T, order=1, mode="nearest", output=np.float64)
        return out

    h = 0.5
    for _ in range(2):
        slope = np.stack(
            [(read(points + h * e) - read(points - h * e)) / (2 * h) for e in np.eye(3)], axis=1
        )
        steep = np.maximum(np.einsum("ij,ij->i", slope, slope), 1e-9)
        step = (read(points) / steep)[:, None] * slope
        length = np.linalg.norm(step, axis=1, keepdims=True)
        points = points - step * np.minimum(1.0, 0.5 / np.maximum(length, 1e-12))
    return points
