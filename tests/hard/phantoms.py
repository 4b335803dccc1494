"""Analytic phantoms and views of them, and how a hard case ends."""

from __future__ import annotations

import dataclasses
import hashlib

import numpy as np

from gcar_deploy.config import PredictOptions, RunOptions
from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import triangulate
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.tree.tree import Tree
from tests.tree.shapes import branch
from tests.tubes.oracle import path_lengths

SIDE = 128
EDGE_MM = 80.0
GRID = Grid(center_mm=(0, 0, 0), size_mm=(EDGE_MM,) * 3, shape=(80,) * 3)
PATH = Intensity(kind="path_length", polarity="bright", mm_per_count=0.001)
DONE = {"ok", "degraded"}
NOT_OK = {"degraded", "refused"}


def straight(axis=(0.2, 0.4, 1.0), length=60.0, radius=1.4, middle=(0.0, 0.0, 0.0)):
    """P1: one straight tube."""
    s = np.linspace(-length / 2, length / 2, 61)
    line = np.asarray(middle) + s[:, None] * np.asarray(axis) / np.linalg.norm(axis)
    return Tree(nodes_mm=line[[0, -1]], branches=(branch(line, radius),))


def helix():
    """P2: one and a half turns, tapering."""
    t = np.linspace(0, 3 * np.pi, 120)
    line = np.stack([14 * np.cos(t), 10 * np.sin(t) + 3, np.linspace(-24, 26, 120)], 1)
    return Tree(nodes_mm=line[[0, -1]], branches=(branch(line, np.linspace(1.9, 1.0, 120)),))


def seven():
    """P3: a tree of seven branches, radii 2 to 0.8 mm, without any symmetry."""
    nodes = np.array(
        [[-6, 4, 30], [2, -3, 14], [-12, 6, 2], [16, -8, 4], [-22, 16, -18], [-6, 0, -26],
         [28, -20, -8], [14, 4, -22]], float
    )  # fmt: skip
    ends = ((0, 1), (1, 2), (1, 3), (2, 4), (2, 5), (3, 6), (3, 7))
    radii = ((2.0, 1.7), (1.6, 1.4), (1.5, 1.3), (1.2, 0.9), (1.1, 0.8), (1.1, 0.9), (1.0, 0.8))
    s = np.linspace(0, 1, 30)
    branches = []
    for k, ((a, b), (first, last)) in enumerate(zip(ends, radii, strict=True)):
        bow = np.roll([3.0, 1.5, -2.0], k)
        line = nodes[a] + s[:, None] * (nodes[b] - nodes[a]) + np.sin(np.pi * s)[:, None] * bow
        branches.append(branch(line, np.linspace(first, last, 30), a, b))
    return Tree(nodes_mm=nodes, branches=tuple(branches))


def bars(count, gap=14.0):
    """``count`` parallel tubes across the epipolar planes of views that turn about z."""
    x = (np.arange(count) - (count - 1) / 2) * gap
    parts = [straight((0.0, 0.02 * (k + 1), 1.0), 40.0, 1.3, (a, 0.3 * a, 0)).branches[0]
             for k, a in enumerate(x)]  # fmt: skip
    nodes = np.concatenate([p.points_mm[[0, -1]] for p in parts])
    return Tree(
        nodes_mm=nodes,
        branches=tuple(
            dataclasses.replace(p, start=2 * k, end=2 * k + 1) for k, p in enumerate(parts)
        ),
    )


def both(*trees):
    """Several trees as one."""
    nodes, branches = [], []
    for tree in trees:
        used = sum(len(n) for n in nodes)
        nodes.append(tree.nodes_mm)
        branches += [
            dataclasses.replace(b, start=b.start + used, end=b.end + used) for b in tree.branches
        ]
    return Tree(nodes_mm=np.concatenate(nodes), branches=tuple(branches))


def carm(primary, secondary=0.0, **changes):
    fields = {"sod_mm": 765.0, "sdd_mm": 1200.0, "rows": SIDE, "columns": SIDE,
              "pixel_spacing_mm": (1.2, 1.2)}  # fmt: skip
    return CArm(primary_angle_deg=primary, secondary_angle_deg=secondary, **{**fields, **changes})


PAIR = (carm(-30, -20), carm(45, 25))


def path_of(tree, view):
    """(rows, cols) path length of the phantom, mm."""
    return path_lengths(tree, view)


def angiogram(view, pixels, name, intensity=PATH, bits=16):
    pixels = np.asarray(pixels, np.float32)
    return Angiogram(
        view_id=name, carm=view, pixels=pixels, bit_depth=bits, intensity=intensity,
        sha256=hashlib.sha256(pixels.tobytes() + name.encode()).hexdigest(),
    )  # fmt: skip


def paths(tree, views=PAIR):
    """Angiograms of calibrated path lengths."""
    return [angiogram(v, np.rint(path_of(tree, v) * 1000), str(k + 1)) for k, v in enumerate(views)]


def told(pictures, views):
    """Return the same pictures with other geometry."""
    return [dataclasses.replace(p, carm=v) for p, v in zip(pictures, views, strict=True)]


def described(tree, real, views, pixels=lambda p: p):
    """Tree that pictures taken by ``real`` show to who takes them for those of ``views``.

    ``pixels`` is what was done to the pictures besides.
    """

    def seen_at(points):
        return triangulate(list(views), [pixels(v.project(points)[0]) for v in real])[0]

    branches = tuple(dataclasses.replace(b, points_mm=seen_at(b.points_mm)) for b in tree.branches)
    return dataclasses.replace(tree, nodes_mm=seen_at(tree.nodes_mm), branches=branches)


def changed(pictures, change, only=None):
    """Pixels of all views, or of one, through a function."""
    return [
        p if only is not None and k != only else angiogram(p.carm, change(p.pixels), p.view_id)
        for k, p in enumerate(pictures)
    ]


def raw(tree, views=PAIR, *, photons=1e4, seed=0, mu=0.12, kind="raw", polarity="dark", add=None):
    """8-bit pictures of counts N0 exp(-mu p) with Poisson noise."""
    rng = np.random.default_rng(seed)
    out = []
    for k, view in enumerate(views):
        counts = rng.poisson(photons * np.exp(-mu * path_of(tree, view))) / photons
        grey = np.clip(np.rint(200 * counts), 0, 255)
        grey = grey if add is None else np.clip(add(grey), 0, 255)
        grey = 255 - grey if polarity == "bright" else grey
        out.append(
            angiogram(view, grey, str(k + 1), Intensity(kind=kind, polarity=polarity), bits=8)
        )
    return out


@dataclasses.dataclass(frozen=True, eq=False)
class Outcome:
    """Class of the end (status, or ``error`` with its exit code), and the result if any."""

    kind: str
    result: object = None
    sentence: str = ""


def outcome(make, engine, grid=GRID) -> Outcome:
    """Run a case; whatever is not an error of ours is raised."""
    try:
        result = engine.reconstruct(make(), grid)
    except GcarError as error:
        kind = {6: "refused", 8: "failed"}.get(error.exit_code, f"error {error.exit_code}")
        assert "\n" not in str(error) and str(error)
        return Outcome(kind, None, str(error))
    return Outcome(result.quality.status, result, result.quality.sentence)


def engine_without_model():
    return Engine(options=RunOptions(predict=PredictOptions(predictor="none")), threads=1)


def distances(tree: Tree, truth: Tree):
    """(n,) distance of each point of ``tree`` from the true centreline, and its sigma, mm."""
    a = np.concatenate([b.points_mm[:-1] for b in truth.branches])
    step = np.concatenate([np.diff(b.points_mm, axis=0) for b in truth.branches])
    rel = tree.points()[:, None] - a
    t = np.clip(np.sum(rel * step, -1) / np.maximum(np.sum(step**2, -1), 1e-12), 0, 1)
    error = np.linalg.norm(rel - t[..., None] * step, axis=-1).min(axis=1)
    return error, np.concatenate([b.sigma_mm for b in tree.branches])


def everything_finite(result) -> bool:
    tree, g = result.tree, result.gaussians
    arrays = [
        tree.points(), tree.radii(), *(b.sigma_mm for b in tree.branches), result.volume,
        g.means_mm, g.scales_mm, g.quaternions_wxyz, g.intensity,
    ]  # fmt: skip
    return all(np.isfinite(a).all() for a in arrays)
