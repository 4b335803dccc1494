"""Where another vessel, or a far part of the same one, lies on a line across a vessel."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.types import Array, Points, Scalars

#: what lies within so many of the own radii is the own lumen: a branch begins there
OWN_RADII = 1.2
#: a place so many of its radii beside a wider vessel is still within it
BESIDE_RADII = 0.5
#: the same vessel is no overlap within so many radii along it, and so many mm
NEAR_RADII, NEAR_MM = 3.0, 2.0


@dataclasses.dataclass(frozen=True, eq=False)
class Course:
    """Places along all branches, seen by one view.

    Attributes
    ----------
    points_mm, radius_mm : (n, 3), (n,)
    branch, arc_mm : (n,) branch and distance along it
    pixels : (n, 2) projected
    along, across : (n, 2) unit vectors in the picture
    px_per_mm : (n,) at the vessel
    """

    points_mm: Points
    radius_mm: Scalars
    branch: Array
    arc_mm: Scalars
    pixels: Array
    along: Array
    across: Array
    px_per_mm: Scalars


def within_others(points_mm: Points, radius_mm: Scalars, branch: Array) -> Array:
    """(n,) whether a place lies in, or by ``BESIDE_RADII`` of its own beside, a wider vessel.

    A branch that leaves its parent at a small angle has no lumen of its own before that.
    """
    lookup = cKDTree(points_mm)
    far = (1 + BESIDE_RADII) * float(radius_mm.max(initial=0.0))
    pairs = lookup.sparse_distance_matrix(lookup, far, output_type="ndarray")
    i, j = pairs["i"], pairs["j"]
    within = (branch[i] != branch[j]) & (radius_mm[j] > radius_mm[i])
    within &= pairs["v"] < radius_mm[j] + BESIDE_RADII * radius_mm[i]
    out = np.zeros(len(points_mm), bool)
    out[i[within]] = True
    return out


def hidden_samples(course: Course, x_mm: Array, blur_mm: float) -> Array:
    """(n, m) whether a sample of the line across a vessel lies in another vessel's shadow.

    Parameters
    ----------
    course : Course of n places
    x_mm : (n, m) ascending distances from the axis
    blur_mm : a shadow reaches beyond its edge by so much
    """
    n, m = x_mm.shape
    radius_px = course.radius_mm * course.px_per_mm
    far = float((x_mm[:, -1] * course.px_per_mm + radius_px.max(initial=0.0)).max(initial=1.0))
    # Every third place stands for its neighbours: discs overlap by far more than that.
    some = np.arange(0, n, 3)
    pairs = cKDTree(course.pixels).sparse_distance_matrix(
        cKDTree(course.pixels[some]), far, output_type="ndarray"
    )
    # A shadow that ends before the line begins hides nothing.
    to = (x_mm[:, -1] + blur_mm) * course.px_per_mm
    near = np.flatnonzero(pairs["v"] <= to[pairs["i"]] + radius_px[some][pairs["j"]])
    i, j = pairs["i"][near], some[pairs["j"][near]]
    apart = np.abs(course.arc_mm[i] - course.arc_mm[j])
    reach = NEAR_RADII * np.maximum(course.radius_mm[i], course.radius_mm[j]) + NEAR_MM
    other = (course.branch[i] != course.branch[j]) | (apart > reach)
    i, j = i[other], j[other]
    gap = course.points_mm[i] - course.points_mm[j]
    own = np.einsum("ij,ij->i", gap, gap) < (OWN_RADII * course.radius_mm[i]) ** 2
    i, j = i[~own], j[~own]
    shift = course.pixels[j] - course.pixels[i]
    beside = np.einsum("ij,ij->i", shift, course.across[i])
    ahead = np.einsum("ij,ij->i", shift, course.along[i])
    chord = radius_px[j] ** 2 - ahead**2
    crosses = chord > 0
    i, beside, chord = i[crosses], beside[crosses], np.sqrt(chord[crosses])
    step = x_mm[:, 1] - x_mm[:, 0]
    half = chord / course.px_per_mm[i] + blur_mm
    middle = beside / course.px_per_mm[i]
    first = np.ceil((middle - half - x_mm[i, 0]) / step[i]).clip(0, m).astype(np.int64)
    last = np.floor((middle + half - x_mm[i, 0]) / step[i]).clip(-1, m - 1).astype(np.int64) + 1
    # Count how many shadows have begun and not ended at each sample.
    begun = np.bincount(i * (m + 1) + first, minlength=n * (m + 1))
    ended = np.bincount(i * (m + 1) + np.maximum(first, last), minlength=n * (m + 1))
    out: Array = np.cumsum((begun - ended).reshape(n, m + 1), axis=1)[:, :m] > 0
    return out
