"""Trees that grow towards places on an ellipsoid: no anatomy is told, and flow gives calibres.

Each end that is to be supplied is joined to the nearest vessel above it, as in constructive
optimisation (Schreiner & Buxbaum 1993), and radii follow from the flow through them by a power law.
They share nothing with ``trees`` but the ellipsoid, and no network saw one.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from gcar_deploy.tree.tree import polyline_arc
from gcar_deploy.types import Array, Points, Scalars
from gcar_export.scenes.tree_curves import Vessel
from gcar_export.scenes.trees import SyntheticTree

#: between two nodes on the way to an end, and between points of a vessel, mm
_NODE_MM, _STEP_MM = 6.0, 0.4
#: no two ends are nearer than this, mm, if so many draws find a place
_APART_MM, _DRAWS = 12.0, 60
#: a way up is so much farther than it is, mm: vessels run downwards
_UP_MM = 40.0
#: no lumen is thinner, mm radius
_THINNEST_MM = 0.22
#: mean number of narrow or wide places in a vessel
_LESIONS = 0.35


def grown_tree(rng: np.random.Generator) -> SyntheticTree:
    """Draw a tree of 3 to 12 ends, of 0.3 to 2.4 mm radius, about the origin."""
    points, parent = _ways(rng)
    flow = _flow(parent, rng)
    widest, exponent = rng.uniform(1.4, 2.4), rng.uniform(2.3, 3.0)
    radius = np.maximum(widest * (flow / flow[0]) ** (1 / exponent), rng.uniform(0.28, 0.5))
    wind = _winding(rng)
    place = rng.normal(0, 6, 3)
    lines = [(points[run], radius[run]) for run in _runs(parent, flow)]
    drawn = [_vessel(own, wide, wind, rng) for own, wide in lines]
    middle = np.concatenate([line for line, _ in drawn]).mean(axis=0) - place
    vessels = (
        Vessel(name=str(k), side="grown", points_mm=line - middle, radius_mm=wide)
        for k, (line, wide) in enumerate(drawn)
    )
    return SyntheticTree(vessels=tuple(vessels))


def _ways(rng: np.random.Generator) -> tuple[Points, Array]:
    """(n, 3) nodes, mm, and (n,) the node before each, -1 of the inlet, which is the first."""
    axes = rng.uniform([28, 28, 38], [40, 40, 52])
    about, spread = rng.uniform(0, 2 * np.pi), rng.uniform(0.7, 1.4)

    def on_heart(point: Array) -> Array:
        scaled = point / axes
        out: Array = scaled / np.linalg.norm(scaled) * axes
        return out

    def end(lowest: float, highest: float) -> Array:
        angle, height = rng.normal(about, spread), rng.uniform(lowest, highest)
        across = np.sqrt(1 - height**2)
        return on_heart(axes * [across * np.cos(angle), across * np.sin(angle), height])

    points = [on_heart(axes * [0.5 * np.cos(about), 0.5 * np.sin(about), 0.85])]
    parent = [-1]
    for k in range(int(rng.integers(3, 13))):
        for _ in range(_DRAWS):
            aim = end(-0.95, 0.6 if k else -0.3)
            if np.linalg.norm(np.array(points) - aim, axis=1).min() > _APART_MM:
                break
        nodes = np.array(points)
        far = np.linalg.norm(nodes - aim, axis=1)
        last = int(np.argmin(far + np.where(nodes[:, 2] > aim[2] + 2, 0, _UP_MM))) if k else 0
        begin, count = points[last], max(2, round(far[last] / _NODE_MM))
        for i in range(1, count + 1):
            points.append(on_heart(begin + (aim - begin) * i / count))
            parent.append(last)
            last = len(points) - 1
    return np.array(points), np.array(parent)


def _flow(parent: Array, rng: np.random.Generator) -> Scalars:
    """(n,) flow through each node: every end asks for some."""
    flow = np.zeros(len(parent))
    ends = np.bincount(parent[1:], minlength=len(parent)) == 0
    flow[ends] = rng.uniform(0.4, 1.6, int(ends.sum()))
    for node in range(len(parent) - 1, 0, -1):  # nodes stand behind those before them
        flow[parent[node]] += flow[node]
    return flow


def _runs(parent: Array, flow: Scalars) -> list[list[int]]:
    """Nodes of each vessel: at a fork it goes on where more flows, and others begin there."""
    after: dict[int, list[int]] = {}
    for node in np.argsort(-flow, kind="stable").tolist():
        after.setdefault(int(parent[node]), []).append(node)
    out, begins = [], [[0]]
    while begins:
        run = begins.pop()
        while run[-1] in after:
            on, *side = after[run[-1]]
            begins += [[run[-1], node] for node in side]
            run.append(on)
        out.append(run)
    return out


def _winding(rng: np.random.Generator) -> Array:
    """(3, 3, 6) amplitudes, mm, frequencies, 1/mm, and phases of the waves of a tree."""
    size = (3, 6)
    amplitude = np.full(size, rng.uniform(0.1, 0.7))
    return np.stack([amplitude, rng.uniform(0.1, 0.6, size), rng.uniform(0, 6.28, size)])


def _vessel(
    nodes: Points, radius: Scalars, wind: Array, rng: np.random.Generator
) -> tuple[Points, Scalars]:
    """(m, 3) points and (m,) radii of a vessel through its nodes, mm, with its lesions."""
    arc = polyline_arc(nodes)
    at = np.arange(0, arc[-1], _STEP_MM)
    line = CubicSpline(arc, nodes)(at) if len(nodes) > 2 else nodes[0] + np.outer(
        at / arc[-1], nodes[1] - nodes[0]
    )  # fmt: skip
    amplitude, frequency, phase = wind
    # Six waves each way, two along each axis.
    waves = amplitude * np.sin(frequency * np.tile(line, 2)[:, None] + phase)
    # A side branch begins as wide as it goes on.
    wide = np.interp(at, arc, np.concatenate([[min(radius[0], 1.15 * radius[1])], radius[1:]]))
    wide = gaussian_filter1d(wide, 6, mode="nearest") * np.linspace(1.1, 0.85, len(at))
    for _ in range(rng.poisson(_LESIONS)):
        middle, length = rng.uniform(0.15, 0.85) * at[-1], rng.uniform(1, 4)
        depth = rng.uniform(-0.65, 0.5)
        wide = wide * (1 + depth * np.exp(-0.5 * ((at - middle) / length) ** 2))
    return line + waves.sum(axis=2), np.maximum(wide, _THINNEST_MM)
