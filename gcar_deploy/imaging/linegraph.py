"""A one-pixel-wide line as a graph of its pixels: ends, distances along it, walks."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Mapping
from typing import TypeAlias

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from gcar_deploy.types import Mask

#: (row, col)
Pixel: TypeAlias = "tuple[int, int]"
_STRAIGHT = ((-1, 0), (1, 0), (0, -1), (0, 1))
_DIAGONAL = ((-1, -1), (-1, 1), (1, -1), (1, 1))


class LineGraph:
    """Pixels of a skeleton, joined to their neighbours.

    A diagonal step counts only where no two straight steps make it, so that the corner of a
    line is no fork.
    """

    def __init__(self, line: Mask) -> None:
        """Take the True pixels of ``line``, (rows, cols)."""
        rows, columns = np.nonzero(line)
        self._pixels = set(zip(rows.tolist(), columns.tolist(), strict=True))
        self._joined: dict[Pixel, list[Pixel]] = {}

    def joined(self, pixel: Pixel) -> list[Pixel]:
        """Return the neighbours of a pixel, straight ones first."""
        known = self._joined.get(pixel)
        if known is None:
            row, column = pixel
            inside = self._pixels
            known = [(row + r, column + c) for r, c in _STRAIGHT if (row + r, column + c) in inside]
            known += [
                (row + r, column + c)
                for r, c in _DIAGONAL
                if (row + r, column + c) in inside
                and (row + r, column) not in inside
                and (row, column + c) not in inside
            ]
            self._joined[pixel] = known
        return known

    def ends(self, where: Mask) -> list[Pixel]:
        """Pixels in ``where`` with one neighbour, in the order of rows and columns."""
        rows, columns = np.nonzero(where)
        asked = zip(rows.tolist(), columns.tolist(), strict=True)
        return [p for p in asked if p in self._pixels and len(self.joined(p)) == 1]

    def distances(self, start: Pixel, limit: float, barred: Iterable[Pixel]) -> dict[Pixel, float]:
        """Distance along the line in pixels, up to ``limit``, without stepping on ``barred``."""
        number, links = self._links
        closed = np.zeros(len(number), bool)
        closed[[number[pixel] for pixel in barred]] = True
        open_ = ~(closed[links.row] | closed[links.col])
        ways = sparse.csr_matrix(
            (links.data[open_], (links.row[open_], links.col[open_])), shape=links.shape
        )
        length = csgraph.dijkstra(ways, indices=number[start], limit=limit)
        return {pixel: float(length[k]) for pixel, k in number.items() if np.isfinite(length[k])}

    @functools.cached_property
    def _links(self) -> tuple[dict[Pixel, int], sparse.coo_matrix]:
        """Number of each pixel, and the length of each step."""
        number = {pixel: k for k, pixel in enumerate(sorted(self._pixels))}
        steps = [
            (k, number[near], math.dist(pixel, near))
            for pixel, k in number.items()
            for near in self.joined(pixel)
        ]
        rows, columns, lengths = zip(*steps, strict=True) if steps else ((), (), ())
        size = (len(number), len(number))
        return number, sparse.coo_matrix((lengths, (rows, columns)), shape=size)

    def shortest(self, distances: Mapping[Pixel, float], last: Pixel) -> list[Pixel]:
        """Way along the line from the start of ``distances`` to ``last``."""
        path = [last]
        while distances[path[-1]] > 0:
            path.append(min(self.joined(path[-1]), key=lambda p: distances.get(p, np.inf)))
        return path[::-1]

    def walk(self, end: Pixel, spur_px: float, longest_px: float) -> tuple[list[Pixel], set[Pixel]]:
        """Go from an end along the line as far as it does not branch.

        Returns
        -------
        path : list of Pixel
            From ``end`` to the first fork with two branches longer than ``spur_px``, to the
            other end, or as far as ``longest_px`` pixels.
        spurs : set of Pixel
            Of the shorter branches that were passed.
        """
        path, seen, spurs = [end], {end}, set[Pixel]()
        while len(path) < longest_px:
            onward = [p for p in self.joined(path[-1]) if p not in seen]
            if len(onward) > 1:
                reach = {
                    p: self.distances(p, spur_px, [*seen, *(q for q in onward if q != p)])
                    for p in onward
                }
                large = [p for p in onward if max(reach[p].values()) >= spur_px - 1.5]
                if len(large) != 1:
                    break
                for pixel in onward:
                    if pixel != large[0]:
                        seen |= reach[pixel].keys()
                        spurs |= reach[pixel].keys()
                onward = large
            if not onward:
                break
            path.append(onward[0])
            seen.add(onward[0])
        return path, spurs

    def branches(
        self, distances: Mapping[Pixel, float], low: float, high: float
    ) -> list[list[Pixel]]:
        """Return the connected stretches of pixels that lie between two distances."""
        left = {p for p, d in distances.items() if low <= d <= high}
        stretches = []
        while left:
            stretch, new = [], [left.pop()]
            while new:
                pixel = new.pop()
                stretch.append(pixel)
                near = [p for p in self.joined(pixel) if p in left]
                left.difference_update(near)
                new.extend(near)
            stretches.append(sorted(stretch))
        return stretches
