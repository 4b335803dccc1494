"""Reference diameter of every vessel, from ostium to tip, with steps at bifurcations.

Between bifurcations a healthy vessel is a straight taper; at a bifurcation flow divides, and
diameters with it, d_parent^q = sum d_child^q. All branches of a tree are fitted at once: a branch
that is narrowed over most of its length, or too short to say, has its reference from the others.
Lesions and flares are outliers: first a line through the wider parts (expectile), then weights that
fall to nothing (Tukey's biweight) round what is left.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gcar_deploy.measure.sections import Sections
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Scalars

#: exponent of the flow law, measured in human coronary bifurcations, and how well it holds (log)
FLOW_EXPONENT, LAW_SD = 2.38, 0.2
#: usual taper, share of the diameter a mm, and its spread
TAPER, TAPER_SD = -0.003, 0.006
#: a branch's own level before its wall is looked at, standard deviation of the log
LEVEL_SD = 0.6
#: wall roughness along which lengths are independent, mm; bounds of its scatter, share
ROUGH_MM, SCATTER = 2.0, (0.03, 0.15)
#: share of the diameters below the first line; deviations beyond which none counts
EXPECTILE, OUTLIER = 0.85, 2.5
_FIRST, _ROUNDS = 4, 8
_LEAST_MM = 0.3


def reference_lines(
    tree: Tree, sections: Sequence[Sections], clear: Sequence[Array]
) -> tuple[Scalars, ...]:
    """Fit the reference diameter of every branch.

    Parameters
    ----------
    tree : Tree; branches run away from their inlets
    sections : of each branch
    clear : of each branch (m,) bool, sections that tell of its calibre

    Returns
    -------
    per branch (m,) reference diameter at each section, mm
    """
    count = len(tree.branches)
    if not count:
        return ()
    level: Scalars = np.array([_usual(own, use) for own, use in zip(sections, clear, strict=True)])
    slope: Scalars = TAPER * level
    middle: Scalars = np.array([0.5 * own.arc_mm[-1] for own in sections])
    scatter = SCATTER[1]
    wholes = [_spans(own.arc_mm)[use] / ROUGH_MM for own, use in zip(sections, clear, strict=True)]
    told = [
        (own.arc_mm[use] - middle[k], own.diameter_mm[use], np.nan_to_num(own.sigma_mm[use]))
        for k, (own, use) in enumerate(zip(sections, clear, strict=True))
    ]
    forks = _forks(tree)
    for number in range(_FIRST + _ROUNDS):
        H, pull = _wishes(forks, level, slope, middle)
        left = []
        for k, (off, diameter, sigma) in enumerate(told):
            line = np.maximum(level[k] + slope[k] * off, _LEAST_MM)
            z = diameter / line - 1
            left.append(z)
            variance = scatter**2 + (sigma / line) ** 2
            if number < _FIRST:
                weight = np.where(z > 0, EXPECTILE, 1 - EXPECTILE)
            else:
                weight = np.maximum(1 - z**2 / (OUTLIER**2 * variance), 0.0) ** 2
            weight = weight * wholes[k] / (variance * line**2)
            tilted = weight * off
            H[k, k] += weight.sum()
            H[k, count + k] += tilted.sum()
            H[count + k, k] += tilted.sum()
            H[count + k, count + k] += tilted @ off
            pull[k] += weight @ diameter
            pull[count + k] += tilted @ diameter
        found = np.asarray(np.linalg.solve(H, pull), dtype=np.float64)
        level = np.asarray(np.maximum(found[:count], _LEAST_MM), dtype=np.float64)
        slope = found[count:]
        if number >= _FIRST - 1:
            scatter = _scatter(np.concatenate(left))
    return tuple(
        np.maximum(level[k] + slope[k] * (own.arc_mm - middle[k]), _LEAST_MM)
        for k, own in enumerate(sections)
    )


def _usual(own: Sections, use: Array) -> float:
    return float(np.median(own.diameter_mm[use] if use.any() else own.diameter_mm))


def _spans(arc_mm: Scalars) -> Scalars:
    """(m,) length that each section stands for."""
    edges = np.concatenate([arc_mm[:1], 0.5 * (arc_mm[1:] + arc_mm[:-1]), arc_mm[-1:]])
    return np.diff(edges)


def _scatter(left: Scalars) -> float:
    """Scatter of healthy walls: of the upper half, which lesions do not touch."""
    above = left[left > 0]
    size = 1.4826 * float(np.median(above)) if len(above) > 4 else SCATTER[0]
    return float(np.clip(size, *SCATTER))


def _forks(tree: Tree) -> list[tuple[int, list[int]]]:
    """Branch and those that begin where it ends, for each place where one becomes several."""
    into: dict[int, list[int]] = {}
    out: dict[int, list[int]] = {}
    for k, branch in enumerate(tree.branches):
        into.setdefault(branch.end, []).append(k)
        out.setdefault(branch.start, []).append(k)
    return [
        (into[node][0], out[node])
        for node in range(len(tree.nodes_mm))
        if len(into.get(node, ())) == 1 and len(out.get(node, ())) > 1
    ]


def _wishes(
    forks: Sequence[tuple[int, list[int]]], level: Scalars, slope: Scalars, middle: Scalars
) -> tuple[Array, Scalars]:
    """Return what is known without a section: normal matrix and right side over the lines.

    The usual taper, a level near the branch's own, and the flow law at every bifurcation, linear
    round the lines as they are: it is homogeneous, so its tangent passes through the origin.
    """
    count, q = len(level), FLOW_EXPONENT
    each = np.arange(count)
    rows = np.zeros((2 * count + len(forks), 2 * count))
    rows[each, count + each], rows[each, each] = 1 / (TAPER_SD * level), -TAPER / (TAPER_SD * level)
    rows[count + each, each] = 1 / (LEVEL_SD * level)
    wanted = np.zeros(len(rows))
    wanted[count + each] = 1 / LEVEL_SD
    for row, (parent, children) in zip(rows[2 * count :], forks, strict=True):
        begin = np.maximum(level[children] - slope[children] * middle[children], _LEAST_MM)
        total = float((begin**q).sum() ** (1 / q))
        by_child = (begin / total) ** (q - 1)
        row[parent], row[count + parent] = 1.0, middle[parent]
        row[children] = -by_child
        row[count + np.array(children)] = by_child * middle[children]
        row /= LAW_SD * total
    return rows.T @ rows, rows.T @ wanted
