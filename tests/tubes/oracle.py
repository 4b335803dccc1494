"""Pictures of made trees by another way than the refiner's: balls cut by the rays of a detector.

A vessel is a row of balls along its centreline, dense enough that their union is smooth. A ray
enters and leaves each ball where a sphere says; the union of these stretches is its path, and a
pixel is the mean over rays spread evenly across it. Nothing is shared with ``tubes/model.py`` but
the ``CArm``, whose own test has closed forms.
"""

from __future__ import annotations

import numpy as np

#: distance between balls, mm: their union is thinner than the tube by step^2 / (8 r)
STEP_MM = 0.2


def balls(tree):
    """(n, 3) middles and (n,) radii of the balls that a tree's branches are made of, mm."""
    middles, radii = [], []
    for branch in tree.branches:
        arc = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(branch.points_mm, axis=0), axis=1))]
        )
        at = np.linspace(0, arc[-1], int(np.ceil(arc[-1] / STEP_MM)) + 1)
        middles.append(np.stack([np.interp(at, arc, x) for x in branch.points_mm.T], axis=1))
        radii.append(np.interp(at, arc, branch.radius_mm))
    return np.concatenate(middles), np.concatenate(radii)


def path_lengths(tree, carm, rays=2):
    """(rows, cols) mean length of vessel along ``rays`` x ``rays`` rays of each pixel, mm."""
    middles, radii = balls(tree)
    fine = (carm.rows * rays, carm.columns * rays)
    ball, pixel = _met(middles, radii, carm, fine, rays)
    position = np.stack([pixel % fine[1], pixel // fine[1]], axis=1)
    direction = carm.rays((position + 0.5) / rays - 0.5)
    # Along the ray, the middle of a ball lies at ``middle``; beside it, at ``off``.
    to_ball = middles[ball] - carm.source_mm
    middle = np.einsum("ij,ij->i", to_ball, direction)
    off = np.linalg.norm(to_ball - middle[:, None] * direction, axis=1)
    cut = off < radii[ball]
    half = np.sqrt(radii[ball][cut] ** 2 - off[cut] ** 2)
    length = _union(pixel[cut], middle[cut] - half, middle[cut] + half, fine[0] * fine[1])
    return length.reshape(carm.rows, rays, carm.columns, rays).mean(axis=(1, 3))


def _met(middles, radii, carm, fine, rays):
    """Pairs (ball, fine pixel) in which a ray can meet a ball: a square round each one's middle."""
    pixels, depth = carm.project(middles)
    reach = 1.1 * radii * max(carm.focal_px) / np.maximum(depth - radii, 1.0) + 1.0
    ball, pixel = [], []
    for k in np.flatnonzero(depth > radii):
        low = np.floor((pixels[k] - reach[k] + 0.5) * rays).astype(int)
        high = np.ceil((pixels[k] + reach[k] + 0.5) * rays).astype(int)
        cols = np.arange(max(low[0], 0), min(high[0] + 1, fine[1]))
        rows = np.arange(max(low[1], 0), min(high[1] + 1, fine[0]))
        pixel.append((rows[:, None] * fine[1] + cols).ravel())
        ball.append(np.full(len(pixel[-1]), k))
    if not ball:
        return np.zeros(0, int), np.zeros(0, int)
    return np.concatenate(ball), np.concatenate(pixel)


def _union(pixel, start, stop, count):
    """(count,) length of the union of each pixel's stretches."""
    order = np.lexsort((start, pixel))
    pixel, start, stop = pixel[order], start[order], stop[order]
    # What stretches before this one in its pixel have reached; pixels are put far apart.
    reached = np.maximum.accumulate(stop + 1e4 * pixel) - 1e4 * pixel
    before = np.concatenate([[-np.inf], reached[:-1]])
    before[np.flatnonzero(np.diff(pixel, prepend=-1))] = -np.inf
    added = np.maximum(stop - np.maximum(start, before), 0.0)
    return np.bincount(pixel, added, minlength=count)
