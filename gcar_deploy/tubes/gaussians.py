"""Gaussians along the tubes of a tree: as few as its length needs, mass kept."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.gaussians.gaussians import Gaussians
from gcar_deploy.tree.tree import Branch, Tree, along
from gcar_deploy.types import Array, Points, Scalars

#: distance between neighbours over their standard deviation along the vessel.
SPACING_SIGMAS = 1.5
#: standard deviation along the vessel over the radius, and its bounds, mm.
LONG_PER_RADIUS = 1.0
LONG_BOUNDS_MM = (0.6, 2.0)
#: passes of the correction where branches overlap.
OVERLAP_PASSES = 3


def gaussians_on_tree(tree: Tree) -> Gaussians:
    """Place Gaussians along every branch.

    Across the vessel sigma = r / sqrt(2): with density 1 on the axis the mass per length is that
    of the tube, pi r^2. Along it they stand 1.5 sigma apart, and each carries the mass of its
    stretch; where branches overlap the intensity is lowered until the sum on the axis is 1.

    Returns
    -------
    Gaussians with ``sigma_mm`` per axis where the tree states it (NaN where it does not)
    """
    parts = [_branch(branch) for branch in tree.branches]
    if not parts:
        return Gaussians(
            means_mm=np.zeros((0, 3)),
            scales_mm=np.zeros((0, 3)),
            quaternions_wxyz=np.zeros((0, 4)),
            intensity=np.zeros(0),
            sigma_mm=np.zeros((0, 3)),
        )
    means, tangents, radius, long_mm, stretch, sigma = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    scales = np.stack([long_mm, radius / np.sqrt(2), radius / np.sqrt(2)], axis=1)
    mass = np.pi * radius**2 * stretch
    intensity = mass / ((2 * np.pi) ** 1.5 * scales.prod(axis=1))
    intensity *= _overlap_factor(means, tangents, scales, intensity)
    return Gaussians(
        means_mm=means,
        scales_mm=scales,
        quaternions_wxyz=_from_x_axis(tangents),
        intensity=intensity,
        sigma_mm=np.repeat(sigma[:, None], 3, axis=1),
    )


def _branch(branch: Branch) -> tuple[Array, ...]:
    """Means, tangents, radius, sigma along, length of stretch, sigma of position."""
    arc = branch.arc_mm
    long_mm = np.clip(LONG_PER_RADIUS * branch.radius_mm, *LONG_BOUNDS_MM)
    # Count in units of the local spacing, so that thin ends get more Gaussians per mm.
    pace = 1.0 / (SPACING_SIGMAS * long_mm)
    steps = np.concatenate([[0.0], np.cumsum(np.diff(arc) * 0.5 * (pace[1:] + pace[:-1]))])
    count = max(int(np.ceil(steps[-1])), 1)
    edges = np.interp(np.linspace(0, steps[-1], count + 1), steps, arc)
    at = 0.5 * (edges[1:] + edges[:-1])
    means = along(branch.points_mm, arc, at)
    tangents = along(branch.tangents, arc, at)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
    stretch = np.diff(edges)
    return (
        means,
        tangents,
        np.interp(at, arc, branch.radius_mm),
        stretch / SPACING_SIGMAS,
        stretch,
        np.interp(at, arc, branch.sigma_mm),
    )


def _overlap_factor(means: Points, tangents: Points, scales: Array, intensity: Scalars) -> Scalars:
    """Factor that brings the summed density at every mean down to 1 where it is above."""
    pairs = cKDTree(means).query_pairs(4.0 * float(scales.max()), output_type="ndarray")
    n = len(means)
    i = np.concatenate([pairs[:, 0], pairs[:, 1], np.arange(n)])
    j = np.concatenate([pairs[:, 1], pairs[:, 0], np.arange(n)])
    rel = means[i] - means[j]
    along = np.einsum("ij,ij->i", rel, tangents[j])
    across2 = np.maximum(np.einsum("ij,ij->i", rel, rel) - along**2, 0.0)
    kernel = np.exp(-0.5 * ((along / scales[j, 0]) ** 2 + across2 / scales[j, 1] ** 2))
    factor = np.ones(n)
    for _ in range(OVERLAP_PASSES):
        density = np.bincount(i, kernel * (factor * intensity)[j], minlength=n)
        factor /= np.maximum(density, 1.0)
    return factor


def _from_x_axis(tangents: Points) -> Array:
    """(n, 4) quaternions wxyz that turn the x axis onto each unit vector."""
    w = 1.0 + tangents[:, 0]
    q = np.stack([w, np.zeros(len(w)), -tangents[:, 2], tangents[:, 1]], axis=1)
    q[w < 1e-6] = (0.0, 0.0, 0.0, 1.0)
    out: Array = q / np.linalg.norm(q, axis=1, keepdims=True)
    return out
