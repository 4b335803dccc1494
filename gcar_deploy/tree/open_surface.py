"""Lumen surface cut flat at its ends, each cut closed by a cap with a name.

An end is cut across its branch half a radius before the last point, where the vessel is still a
tube. Vertices near the plane are moved onto it first, so that the cut leaves no slivers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from gcar_deploy.tree.remesh import even_surface
from gcar_deploy.tree.surface import Surface
from gcar_deploy.tree.tree import Tree, along, polyline_arc
from gcar_deploy.types import Array, Points

WALL = "wall"
#: a vertex so near to the plane is moved onto it, edges of the lattice
SNAP_SHARE = 0.35
#: how far before the end of its branch an end is cut at first, and at last, radii
_CUTS = (0.5, 1.5, 3.0, 5.0)
#: what is cut off reaches no further from the plane's middle than so many radii beyond the end
_REACH = 1.6


@dataclasses.dataclass(frozen=True)
class End:
    """An end to be cut: its name, its branch, and whether it is the branch's first point."""

    name: str
    branch: int
    first: bool


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class OpenSurface:
    """Wall and caps.

    Attributes
    ----------
    surface : Surface, closed by its caps, normals outwards
    face : (f,) of each triangle: 0 wall, k the cap ``names[k]``
    names : ``wall``, then of each cap
    left_round : ends that could not be cut, since another vessel is too near
    """

    surface: Surface
    face: Array
    names: tuple[str, ...]
    left_round: tuple[str, ...]

    def least(self) -> tuple[float, float]:
        """Shortest edge, mm, and smallest angle, degrees, of all triangles."""
        corners = self.surface.vertices_mm[self.surface.faces]
        sides = np.roll(corners, -1, axis=1) - corners
        length = np.linalg.norm(sides, axis=2)
        unit = sides / np.maximum(length, 1e-12)[..., None]
        cosine = -np.einsum("fij,fij->fi", unit, np.roll(unit, 1, axis=1))
        return float(length.min()), float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).min())


def open_surface(tree: Tree, ends: Sequence[End], edge_mm: float | None = None) -> OpenSurface:
    """Mesh a tree and cut its ends.

    Parameters
    ----------
    tree : Tree with a branch
    ends : to be cut
    edge_mm : of the lattice; None takes a share of the smallest radius

    Returns
    -------
    OpenSurface
    """
    closed, edge = even_surface(tree, edge_mm)
    vertices, faces = closed.vertices_mm, closed.faces
    caps: list[tuple[str, Array]] = []
    left_round = []
    for end in ends:
        cut = None
        for radii in _CUTS:
            middle, way, radius, reach = _plane(tree, end, radii)
            cut = _cut(vertices, faces, (middle, way, radius * _REACH + reach), edge)
            if cut is not None:
                break
        if cut is None:
            left_round.append(end.name)
            continue
        vertices, faces, loop = cut
        caps.append((end.name, loop))
    # Caps come last, so that no cut runs through one.
    parts, face = [faces], [np.zeros(len(faces), np.int64)]
    for k, (_, loop) in enumerate(caps, start=1):
        center = len(vertices)
        vertices = np.concatenate([vertices, vertices[loop].mean(axis=0, keepdims=True)])
        fan = np.stack([loop, np.roll(loop, 1), np.full(len(loop), center)], axis=1)
        parts.append(fan)
        face.append(np.full(len(fan), k, np.int64))
    used, renumbered = np.unique(np.concatenate(parts), return_inverse=True)
    return OpenSurface(
        surface=Surface(vertices_mm=vertices[used], faces=renumbered.reshape(-1, 3)),
        face=np.concatenate(face),
        names=(WALL, *(name for name, _ in caps)),
        left_round=tuple(left_round),
    )


def _plane(tree: Tree, end: End, radii: float) -> tuple[Points, Points, float, float]:
    """Middle and outward normal of a cut, the radius there, and how far it is from the end, mm."""
    branch = tree.branches[end.branch]
    turn = 1 if end.first else -1
    points, radius = branch.points_mm[::turn], branch.radius_mm[::turn]
    arc = polyline_arc(points)
    back = min(radii * float(radius[0]), 0.5 * float(arc[-1]))
    r = float(np.interp(back, arc, radius))
    middle, inner = along(points, arc, np.array([back, min(back + r, float(arc[-1]))]))
    outer = along(points, arc, np.array(max(back - r, 0.0)))
    way = outer - inner
    return middle, way / np.linalg.norm(way), r, back


def _cut(
    vertices: Points, faces: Array, plane: tuple[Points, Points, float], edge: float
) -> tuple[Points, Array, Array] | None:
    """Take off what lies beyond a plane round its middle.

    Returns
    -------
    vertices, faces, and the loop of the cut with the wall to its left; None where more than the
    end lies beyond
    """
    middle, way, reach = plane
    s = (vertices - middle) @ way
    s[np.abs(s) < SNAP_SHARE * edge] = 0.0
    off = _beyond(vertices, faces, s, middle, reach)
    if off is None:
        return None
    vertices = vertices.copy()
    # Of the plane as a whole only what is next to the piece that goes.
    beside = np.isin(faces, off).any(axis=1)
    for _ in range(2):
        beside = np.isin(faces, faces[beside]).any(axis=1)
    near = np.unique(faces[beside])
    on = near[s[near] == 0.0]
    vertices[on] -= ((vertices[on] - middle) @ way)[:, None] * way
    gone = np.zeros(len(vertices), bool)
    gone[off] = True
    level = np.where(gone, np.maximum(s, 1e-9), np.minimum(s, 0.0))
    level[~np.isin(np.arange(len(s)), near) & ~gone] = -1.0
    return _clipped(vertices, faces, level)


def _beyond(vertices: Points, faces: Array, s: Array, middle: Points, reach: float) -> Array | None:
    """Vertices of the piece beyond the plane that the end is on; None where it is no mere end."""
    above = s > 0
    near = np.flatnonzero(above & (np.linalg.norm(vertices - middle, axis=1) <= reach))
    if not len(near):
        return None
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = edges[above[edges].all(axis=1)]
    n = len(vertices)
    links = sparse.coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    _, label = csgraph.connected_components(links, directed=False)
    # The end is the piece nearest to the middle; others may reach into the ball from the side.
    piece = label[near[int(np.argmin(np.linalg.norm(vertices[near] - middle, axis=1)))]]
    own = np.flatnonzero((label == piece) & above)
    if np.linalg.norm(vertices[own] - middle, axis=1).max() > reach:
        return None
    return own


def _clipped(vertices: Points, faces: Array, level: Array) -> tuple[Points, Array, Array] | None:
    """Keep what is below level 0; None unless the cut is one loop."""
    high, low = level[faces] > 0, level[faces] < 0
    whole = ~high.any(axis=1) & low.any(axis=1)
    # Triangles that lie in the plane belong to neither side.
    kept = [faces[whole]]
    new: dict[tuple[int, int], int] = {}
    points = [vertices]
    total = len(vertices)

    def crossing(a: int, b: int) -> int:
        nonlocal total
        key = (min(a, b), max(a, b))
        if key not in new:
            t = level[a] / (level[a] - level[b])
            points.append((vertices[a] + t * (vertices[b] - vertices[a]))[None])
            new[key] = total
            total += 1
        return new[key]

    split = []
    for face in faces[high.any(axis=1) & low.any(axis=1)].tolist():
        around = []
        for a, b in zip(face, face[1:] + face[:1], strict=True):
            if level[a] <= 0:
                around.append(a)
            if (level[a] < 0 < level[b]) or (level[b] < 0 < level[a]):
                around.append(crossing(a, b))
        split += [[around[0], around[k], around[k + 1]] for k in range(1, len(around) - 1)]
    kept.append(np.array(split, np.int64).reshape(-1, 3))
    out = np.concatenate(kept)
    loop = _loop(out, faces)
    return None if loop is None else (np.concatenate(points), out, loop)


def _loop(faces: Array, before: Array) -> Array | None:
    """Vertices of the only open edge that was not open before, in order; None unless it is one."""

    def open_edges(of: Array) -> set[tuple[int, int]]:
        edges = np.concatenate([of[:, [0, 1]], of[:, [1, 2]], of[:, [2, 0]]])
        pairs = set(map(tuple, edges.tolist()))
        return {(a, b) for a, b in pairs if (b, a) not in pairs}

    fresh = open_edges(faces) - open_edges(before)
    onward = dict(fresh)
    if len(fresh) < 3 or len(onward) != len(fresh):
        return None
    start = next(iter(sorted(onward)))
    out = [start]
    while (following := onward.get(out[-1])) != start:
        if following is None or len(out) > len(onward):
            return None
        out.append(following)
    return np.array(out) if len(out) == len(onward) else None
