"""From weighted points to a tree of centrelines with radii.

The points' confidence is splatted onto a local raster, at the place of the centreline where they
tell of one (``line_votes``), and smoothed; the cells above a hysteresis threshold form a graph,
short gaps included. Starting from the thickest cell of each component, the farthest cell not yet
accounted for is joined to the tree along the cheapest path (cheap in the middle of a vessel), again
and again (the idea of TEASAR, Sato et al. 2000): the result has no loops by construction. The paths
are then drawn to the centroids of the points they stand for and smoothed.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.tree.curves import LEAST_CONFIDENCE, draw_branches
from gcar_deploy.tree.line_votes import as_line_density, line_votes
from gcar_deploy.tree.raster import blurred, depth_of, hysteresis, peaks, splat, touching
from gcar_deploy.tree.tree import Tree, empty_tree
from gcar_deploy.types import Array, Points, Scalars

#: hysteresis on the smoothed confidence: kept from ``LOW`` where connected to ``HIGH``
LOW, HIGH = 0.08, 0.25
#: a side branch must stick out of its parent by this many lattice cells
MIN_BRANCH_CELLS = 4.0
#: a component shorter than this is dropped, lattice cells
MIN_COMPONENT_CELLS = 8.0
#: how strongly a path prefers the middle of a vessel to its rim.
MIDDLE_PREFERENCE = 6.0
#: cost of a bridged cell beside a cell of confident vessel.
BRIDGE_COST = 4.0
#: points further than this from the middle one (along an axis) are no coronary vessel, mm.
MAX_REACH_MM = 200.0
#: cells of the local raster at most, of the points' lattice and of a finer one; where the latter
#: would have more, points stay where they are
MAX_CELLS, MAX_FINE_CELLS = 40_000_000, 80_000_000
#: a larger given radius is no coronary vessel's, mm.
MAX_GIVEN_RADIUS_MM = 6.0
#: empty cells round the raster.
PAD = 4


@dataclasses.dataclass(frozen=True)
class Raster:
    """How points are put onto a raster.

    Attributes
    ----------
    finer : its cells per lattice cell
    smooth_cells : smoothing of the confidence before thresholding, sigma in its cells
    middle_cells : wider smoothing, whose ridges are the middle of vessels; None where those of the
        first are
    cover : a path accounts for what lies nearer than the first number times the depth there and
        the second together, its cells
    gap_cells : gaps between pieces are bridged up to the first number of its cells, of more than
        two views up to the second: each view's gaps tear what all of them see
    """

    finer: int
    smooth_cells: float
    middle_cells: float | None
    cover: tuple[float, float]
    gap_cells: tuple[float, float]


#: of points all through a vessel, and of points on its centreline
SOLID = Raster(1, 0.6, 1.5, cover=(1.5, 1.5), gap_cells=(5.0, 5.0))
LINES = Raster(2, 1.0, None, cover=(1.0, 2.0), gap_cells=(5.0, 10.0))


@dataclasses.dataclass(frozen=True, eq=False)
class CellGraph:
    """Cells above the threshold and the steps between them.

    Attributes
    ----------
    points_mm : (n, 3) cell centres
    value : (n,) smoothed confidence
    depth_cells : (n,) distance to the nearest cell below the threshold, cells
    cost, length : (n, n) sparse symmetric, cost and length in cells of each step
    cell_mm : edge of a cell
    raster : Raster
    """

    points_mm: Points
    value: Scalars
    depth_cells: Scalars
    cost: sparse.csr_matrix
    length: sparse.csr_matrix
    cell_mm: float
    raster: Raster


def build_tree(centers: CenterPoints, views: int = 2) -> Tree:
    """Build the centreline tree of weighted points.

    Parameters
    ----------
    centers : CenterPoints
        ``confidence * spacing_mm**3`` is taken as vessel volume; ``radius_mm`` is used where
        it is finite, and ``offset_mm`` where all radii are.
    views : int
        So many views saw them.

    Returns
    -------
    Tree, possibly with several components, possibly empty; sigma is NaN.
    """
    centers = usable_points(centers)
    if not len(centers):
        return empty_tree()
    raster, seen = SOLID, centers
    if centers.offset_mm is not None and np.isfinite(centers.radius_mm).all():
        votes, cell_mm = line_votes(centers), centers.spacing_mm / LINES.finer
        if np.prod(np.ptp(votes.points_mm, axis=0) / cell_mm + 2 * PAD) <= MAX_FINE_CELLS:
            raster, centers = LINES, votes
            seen = as_line_density(votes, cell_mm, raster.smooth_cells)
    graph = cell_graph(seen, raster, views)
    if not len(graph.points_mm):
        return empty_tree()
    paths = _paths(graph)
    return draw_branches(graph.points_mm, paths, centers)


def usable_points(centers: CenterPoints) -> CenterPoints:
    """Leave out points that are not finite, carry no confidence or lie absurdly far away.

    Confidence is held to 0 .. 1 and a given radius to below ``MAX_GIVEN_RADIUS_MM``.
    """
    weight = np.nan_to_num(centers.confidence, nan=0.0, posinf=1.0, neginf=0.0)
    keep = np.isfinite(centers.points_mm.sum(axis=1)) & (weight > 0)
    reach = min(MAX_REACH_MM, 0.5 * centers.spacing_mm * MAX_CELLS ** (1 / 3))
    some = centers.points_mm[keep]
    if len(some) and np.ptp(some, axis=0).max() >= reach:
        middle = np.median(some, axis=0)
        keep[keep] = np.abs(some - middle).max(axis=1) < reach
    radius = np.where(
        (centers.radius_mm > 0) & (centers.radius_mm < MAX_GIVEN_RADIUS_MM),
        centers.radius_mm,
        np.nan,
    )
    clean = dataclasses.replace(centers, confidence=np.clip(weight, 0.0, 1.0), radius_mm=radius)
    return clean if keep.all() else clean.select(keep)


def cell_graph(centers: CenterPoints, raster: Raster, views: int) -> CellGraph:
    """Rasterise on cells of the points' spacing, smooth, threshold, connect; see ``CellGraph``."""
    h = centers.spacing_mm
    # Aligned with the first point, so that lattice points fall on cell centres.
    origin = centers.points_mm[0]
    centers = centers.select(centers.confidence > LEAST_CONFIDENCE)
    empty = sparse.csr_matrix((0, 0))
    nothing = CellGraph(np.zeros((0, 3)), np.zeros(0), np.zeros(0), empty, empty, h, raster)
    if not len(centers):
        return nothing
    at = (centers.points_mm - origin) / h
    low = np.floor(at.min(axis=0)).astype(np.int64) - PAD
    shape = np.ceil(at.max(axis=0)).astype(np.int64) + PAD + 1 - low
    density = splat(at - low, centers.confidence, shape)
    value = blurred(density, raster.smooth_cells, 3.0)
    mask = hysteresis(value, LOW, HIGH)
    cells = np.stack(np.unravel_index(np.flatnonzero(mask), mask.shape), axis=1)
    if not len(cells):
        return nothing
    pick = tuple(cells.T)
    middle = value
    if raster.middle_cells is not None:
        middle = blurred(np.minimum(density, 1.0), raster.middle_cells, 2.0)
    # How central each cell is: 1 where the middle peaks among the neighbours, else less.
    central = middle[pick].astype(np.float64) / np.maximum(peaks(middle, cells), 1e-12)
    cost, length = _steps(cells, mask.shape, central, raster.gap_cells[views > 2])
    points = origin + (cells + low) * h
    certain = value[pick].astype(np.float64)
    return CellGraph(points, certain, depth_of(cells, mask), cost, length, h, raster)


def _steps(
    cells: Array, shape: tuple[int, ...], central: Scalars, most_gap: float
) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
    """Link neighbours, and bridge between pieces."""
    n = len(cells)
    pairs, length = touching(cells, shape)
    off_middle = 1 - np.minimum(central[pairs[:, 0]], central[pairs[:, 1]])
    cost = length * np.exp(MIDDLE_PREFERENCE * off_middle)
    grid = sparse.csr_matrix((length, (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    piece = csgraph.connected_components(grid, directed=False)[1]
    bridges, gap = _bridges(cells, piece, most_gap)
    pairs = np.concatenate([pairs, bridges])
    length = np.concatenate([length, gap])
    cost = np.concatenate([cost, gap * BRIDGE_COST])
    rows = np.concatenate([pairs[:, 0], pairs[:, 1]])
    cols = np.concatenate([pairs[:, 1], pairs[:, 0]])
    # Costs and lengths share one pattern: where an entry came from says what it is.
    number = sparse.csr_matrix((np.tile(np.arange(len(pairs)), 2), (rows, cols)), shape=(n, n))
    cost_of, length_of = (
        sparse.csr_matrix((values[number.data], number.indices, number.indptr), shape=(n, n))
        for values in (cost, length)
    )
    return cost_of, length_of


def _bridges(cells: Array, piece: Array, most_gap: float) -> tuple[Array, Scalars]:
    """Shortest links between separate pieces, a spanning forest of them: (b, 2), (b,) cells."""
    found: list[tuple[float, int, int]] = []
    count = int(piece.max()) + 1
    members = [np.flatnonzero(piece == k) for k in range(count)]
    trees = [cKDTree(cells[m]) for m in members]
    for i in range(count):
        for j in range(i + 1, count):
            small, large = (i, j) if len(members[i]) <= len(members[j]) else (j, i)
            d, at = trees[large].query(cells[members[small]], distance_upper_bound=most_gap + 1)
            k = int(np.argmin(d))
            if np.isfinite(d[k]):
                found.append((float(d[k]), int(members[small][k]), int(members[large][at[k]])))
    parent = list(range(count))
    kept: list[tuple[float, int, int]] = []
    for gap, a, b in sorted(found):
        ra, rb = _root(parent, int(piece[a])), _root(parent, int(piece[b]))
        if ra != rb:
            parent[ra] = rb
            kept.append((gap, a, b))
    pairs = np.array([[a, b] for _, a, b in kept], dtype=np.int64).reshape(-1, 2)
    return pairs, np.array([gap for gap, _, _ in kept])


def _root(parent: list[int], i: int) -> int:
    while parent[i] != i:
        i = parent[i]
    return i


def _paths(graph: CellGraph) -> list[Array]:
    """Cell paths from each tip to the tree so far; a component's first path is root to tip."""
    count, label = csgraph.connected_components(graph.cost, directed=False)
    order = np.argsort(label, kind="stable")
    members = np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])
    # One search serves all components, which do not touch each other.
    starts = [int(m[np.argmax(graph.depth_cells[m])]) for m in members]
    far = csgraph.dijkstra(graph.length, directed=False, indices=starts, min_only=True)
    # The root is an end of the component, the farthest from its thickest cell.
    roots = [int(m[np.argmax(far[m])]) for m in members]
    reach = csgraph.dijkstra(graph.length, directed=False, indices=roots, min_only=True)
    _, before, _ = csgraph.dijkstra(
        graph.cost, directed=False, indices=roots, min_only=True, return_predecessors=True
    )
    covered = np.zeros(len(label), bool)
    lookup = cKDTree(graph.points_mm)
    paths: list[Array] = []
    for member, root in zip(members, roots, strict=True):
        if reach[member].max() >= MIN_COMPONENT_CELLS * graph.raster.finer:
            tips = member[np.argsort(-reach[member], kind="stable")]
            paths += _component_paths(graph, root, tips, before, covered, lookup)
    return paths


def _component_paths(
    graph: CellGraph,
    root: int,
    tips: Array,
    before: Array,
    covered: Array,
    lookup: cKDTree,
) -> list[Array]:
    """Join the tips, in their order, to the tree that starts with ``root``."""
    on_tree = {root}
    paths: list[Array] = []
    per_depth, beside = graph.raster.cover
    least = MIN_BRANCH_CELLS * graph.raster.finer
    for tip in tips.tolist():
        if covered[tip]:
            continue
        path = [tip]
        while path[-1] not in on_tree:
            path.append(int(before[path[-1]]))
        route = np.array(path)
        hidden = graph.depth_cells[route[-1]]
        steps = (
            np.linalg.norm(np.diff(graph.points_mm[route], axis=0), axis=1).sum() / graph.cell_mm
        )
        keep = not paths or steps - hidden >= least
        if keep:
            paths.append(route)
            on_tree.update(path)
            radius = (per_depth * graph.depth_cells[route] + beside) * graph.cell_mm
            near = lookup.query_ball_point(graph.points_mm[route], radius, return_sorted=False)
            covered[np.fromiter(itertools.chain.from_iterable(near), np.int64)] = True
        else:
            covered[tip] = True
    return paths
