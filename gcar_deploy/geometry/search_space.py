"""Where vessels are looked for when nobody names a volume, whatever border the pictures have."""

from __future__ import annotations

import dataclasses

from gcar_deploy.geometry.grid import MOST_VOXELS, Grid

#: edges of cubes about the scene's middle, mm: of the usual field of view, and of all where a
#: vessel of a heart may be
USUAL_EDGE_MM, WIDEST_EDGE_MM = 128.0, 180.0


def search_spaces(grid: Grid, cell_mm: float) -> tuple[Grid, ...]:
    """Return what is searched, and what further where lines of a picture stay unexplained.

    Parameters
    ----------
    grid : Grid that is asked for, in the scene's own frame
    cell_mm : edge of the cells of the lattice to come, which has its limit too

    Returns
    -------
    ``grid`` where it bounds, else two cubes with as many voxels: lattices are laid by their place
    and size alone, and follow neither the pictures' borders nor the origin of the file
    """
    if grid.bounds:
        return (grid,)
    most = (MOST_VOXELS ** (1 / 3) - 2) * cell_mm
    edges = (min(edge, most) for edge in (USUAL_EDGE_MM, WIDEST_EDGE_MM))
    return tuple(
        dataclasses.replace(grid, center_mm=(0.0, 0.0, 0.0), size_mm=(edge, edge, edge))
        for edge in edges
    )
