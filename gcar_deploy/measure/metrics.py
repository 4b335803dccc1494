"""Measures of a reconstruction against the truth, each with its definition frozen here.

Every measure returns a ``Measure``: a finite value, or ``None`` with the reason. An empty
mask, a missing prediction or two identical pictures never become a 0, a 1 or an infinity by
convention. Volumes are indexed (x, y, z); distances are in mm between voxel centres.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gcar_deploy.types import Array

#: occupancy that counts as vessel, in truth and reconstruction alike.
VOLUME_THRESHOLD = 0.5
#: thresholds on the reconstruction among which ``best_dice`` chooses.
BEST_THRESHOLDS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
#: path length that counts as vessel in a new projection, mm.
PROJECTION_THRESHOLD_MM = 0.5
#: all that ``volume_measures`` knows of
VOLUME_MEASURES = (
    "dsc", "best_dsc", "best_threshold", "ot_1mm", "ot_2mm", "chamfer_mm", "cldice", "ssim",
)  # fmt: skip
#: farthest shift that ``best_shifted_dice`` tries on each axis, voxels
SHIFTED = 3
#: window edge of SSIM, voxels.
SSIM_WINDOW = 7
#: slack on "within r mm", so that a distance equal to r counts whatever its rounding.
DISTANCE_SLACK_MM = 1e-6


class Measure(NamedTuple):
    """A value, or ``None`` and why there is none."""

    value: float | None
    reason: str | None = None


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Skeleton:
    """Skeleton voxels of a mask.

    Attributes
    ----------
    index : (n, 3) int64 voxel indices
    spacing_mm : (3,) voxel edges
    """

    index: Array
    spacing_mm: Array

    @property
    def points_mm(self) -> Array:
        """(n, 3) positions relative to the centre of voxel [0, 0, 0], mm."""
        return self.index * self.spacing_mm


def dice(truth: Array, predicted: Array | None) -> Measure:
    """Dice coefficient of two masks, 2 |A and B| / (|A| + |B|).

    Undefined without a prediction or when either mask is empty.
    """
    reason = _unusable(truth, predicted)
    if reason or predicted is None:
        return Measure(None, reason)
    both = np.count_nonzero(truth & predicted)
    return Measure(2.0 * int(both) / int(np.count_nonzero(truth) + np.count_nonzero(predicted)))


def volume_dice(
    truth: Array, predicted: Array | None, threshold: float = VOLUME_THRESHOLD
) -> Measure:
    """Volume DSC: truth occupancy >= 0.5 against predicted occupancy >= ``threshold``.

    Whole volume, nothing masked. Arrays are (nx, ny, nz), 0 .. 1, on the same grid.
    """
    _same_shape(truth, predicted)
    return dice(truth >= VOLUME_THRESHOLD, None if predicted is None else predicted >= threshold)


def best_dice(truth: Array, predicted: Array | None) -> tuple[Measure, float | None]:
    """Highest ``volume_dice`` over ``BEST_THRESHOLDS`` on the prediction, and its threshold.

    The lowest threshold wins a tie; thresholds that leave nothing of the prediction are
    passed over.
    """
    best, at = Measure(None, None), None
    for threshold in BEST_THRESHOLDS:
        found = volume_dice(truth, predicted, threshold)
        if found.value is not None and (best.value is None or found.value > best.value):
            best, at = found, threshold
        elif best.value is None and best.reason is None:
            best = found
    return best, at


def skeleton(mask: Array, spacing_mm: Sequence[float] | Array) -> Skeleton:
    """Thin a 3D mask to its centreline (skimage ``skeletonize``, Lee et al. 1994)."""
    from skimage.morphology import skeletonize

    spacing = np.asarray(spacing_mm, dtype=np.float64)
    filled = [np.flatnonzero(mask.any(axis=other)) for other in ((1, 2), (0, 2), (0, 1))]
    if not len(filled[0]):
        return Skeleton(index=np.zeros((0, 3), np.int64), spacing_mm=spacing)
    low = np.array([own[0] for own in filled])
    core = mask[tuple(slice(own[0], own[-1] + 1) for own in filled)]
    # One empty voxel all round keeps the result independent of where the box was cut.
    thin = skeletonize(np.pad(core, 1))
    return Skeleton(index=np.argwhere(thin) - 1 + low, spacing_mm=spacing)


def overlap_within(truth: Skeleton, predicted: Skeleton | None, radius_mm: float) -> Measure:
    """Ot(r): share of both skeletons' voxels within ``radius_mm`` of the other skeleton.

    (#{t : d(t, P) <= r} + #{p : d(p, T) <= r}) / (#T + #P), Euclidean distances in mm.
    """
    distances = _distances(truth, predicted)
    if isinstance(distances, str):
        return Measure(None, distances)
    near = sum(int(np.count_nonzero(d <= radius_mm + DISTANCE_SLACK_MM)) for d in distances)
    return Measure(near / sum(len(d) for d in distances))


def chamfer_mm(truth: Skeleton, predicted: Skeleton | None) -> Measure:
    """Mean of the two mean distances between the skeletons, mm."""
    distances = _distances(truth, predicted)
    if isinstance(distances, str):
        return Measure(None, distances)
    return Measure(float(0.5 * (distances[0].mean() + distances[1].mean())))


def cl_dice(
    truth: Array,
    predicted: Array | None,
    truth_skeleton: Skeleton | None = None,
    predicted_skeleton: Skeleton | None = None,
) -> Measure:
    """Centreline Dice of two 3D masks (Shit et al., CVPR 2021).

    Tprec = |S_P and V_T| / |S_P|, Tsens = |S_T and V_P| / |S_T|, clDice their harmonic mean
    (0 when both are 0, its limit). Skeletons are made with ``skeleton`` unless given.
    """
    reason = _unusable(truth, predicted)
    if reason or predicted is None:
        return Measure(None, reason)
    s_truth = truth_skeleton or skeleton(truth, (1, 1, 1))
    s_predicted = predicted_skeleton or skeleton(predicted, (1, 1, 1))
    if not len(s_truth.index) or not len(s_predicted.index):
        return Measure(None, "a skeleton is empty")
    precision = float(truth[tuple(s_predicted.index.T)].mean())
    sensitivity = float(predicted[tuple(s_truth.index.T)].mean())
    total = precision + sensitivity
    return Measure(2 * precision * sensitivity / total if total else 0.0)


def projection_dice(truth_mm: Array, predicted_mm: Array | None) -> Measure:
    """DSC of path length >= 0.5 mm in one new projection; pictures in mm, same shape."""
    _same_shape(truth_mm, predicted_mm)
    level = PROJECTION_THRESHOLD_MM
    return dice(truth_mm >= level, None if predicted_mm is None else predicted_mm >= level)


def psnr_db(truth: Array, predicted: Array | None, *, masked: bool = False) -> Measure:
    """Peak signal-to-noise ratio, 10 log10(peak^2 / mean squared error), dB.

    The peak is the truth's maximum. Over all pixels, or with ``masked`` over those with
    truth > 0 only (the figure of the paper's code). Undefined where the truth is nowhere
    above 0, and for identical pictures (infinite).
    """
    _same_shape(truth, predicted)
    if predicted is None:
        return Measure(None, "no prediction")
    peak = float(truth.max()) if truth.size else 0.0
    if peak <= 0:
        return Measure(None, "truth is empty")
    difference = truth.astype(np.float64) - predicted
    error = float(np.mean((difference[truth > 0] if masked else difference) ** 2))
    if not math.isfinite(error):
        return Measure(None, "prediction is not finite")
    if error == 0:
        return Measure(None, "identical")
    return Measure(10.0 * math.log10(peak**2 / error))


def ssim(truth: Array, predicted: Array | None) -> Measure:
    """Structural similarity of two volumes or pictures, data range 1, whole array.

    skimage ``structural_similarity`` with its uniform 7-voxel window (Wang et al. 2004).
    """
    _same_shape(truth, predicted)
    if predicted is None:
        return Measure(None, "no prediction")
    if min(truth.shape) < SSIM_WINDOW:
        return Measure(None, f"smaller than the {SSIM_WINDOW}-voxel window")
    from skimage.metrics import structural_similarity

    value = float(
        structural_similarity(
            truth.astype(np.float32),
            predicted.astype(np.float32),
            data_range=1.0,
            win_size=SSIM_WINDOW,
        )
    )
    return Measure(value) if math.isfinite(value) else Measure(None, "prediction is not finite")


def volume_measures(
    truth: Array,
    predicted: Array | None,
    spacing_mm: Sequence[float] | Array,
    names: Sequence[str] = VOLUME_MEASURES,
) -> dict[str, Measure]:
    """Measures of two occupancy volumes on one grid, by name.

    Masks and skeletons are taken at 0.5. ``ssim`` takes longer than all others together.
    """
    _same_shape(truth, predicted)
    if predicted is not None and not np.isfinite(predicted).all():
        predicted = None
    mask_truth = truth >= VOLUME_THRESHOLD
    mask_predicted = None if predicted is None else predicted >= VOLUME_THRESHOLD
    s_truth = skeleton(mask_truth, spacing_mm)
    s_predicted = None if mask_predicted is None else skeleton(mask_predicted, spacing_mm)

    best = functools.cache(lambda: best_dice(truth, predicted))
    makers = {
        "dsc": lambda: dice(mask_truth, mask_predicted),
        "best_dsc": lambda: best()[0],
        "best_threshold": lambda: Measure(best()[1], best()[0].reason),
        "ot_1mm": lambda: overlap_within(s_truth, s_predicted, 1.0),
        "ot_2mm": lambda: overlap_within(s_truth, s_predicted, 2.0),
        "chamfer_mm": lambda: chamfer_mm(s_truth, s_predicted),
        "cldice": lambda: cl_dice(mask_truth, mask_predicted, s_truth, s_predicted),
        "ssim": lambda: ssim(truth, predicted),
    }
    return {name: makers[name]() for name in names}


def projection_measures(truth_mm: Array, predicted_mm: Array | None) -> dict[str, Measure]:
    """All measures of one new projection: ``dsc``, ``psnr_db``, ``psnr_masked_db``."""
    return {
        "dsc": projection_dice(truth_mm, predicted_mm),
        "psnr_db": psnr_db(truth_mm, predicted_mm),
        "psnr_masked_db": psnr_db(truth_mm, predicted_mm, masked=True),
    }


def best_shifted_dice(truth: Array, predicted: Array | None) -> Measure:
    """Highest ``volume_dice`` over shifts of the prediction by up to ``SHIFTED`` whole voxels.

    For pictures of a patient who moved between the views: no pair of views can see the
    common shift. Shifts run over -SHIFTED .. SHIFTED on each axis.
    """
    _same_shape(truth, predicted)
    mask = truth >= VOLUME_THRESHOLD
    moved = None if predicted is None else predicted >= VOLUME_THRESHOLD
    reason = _unusable(mask, moved)
    if reason or moved is None:
        return Measure(None, reason)
    size = np.count_nonzero(mask) + np.count_nonzero(moved)
    index = np.argwhere(moved)
    padded = np.pad(mask, SHIFTED)
    steps = range(0, 2 * SHIFTED + 1)
    hits = (
        np.count_nonzero(padded[tuple((index + np.array([i, j, k])).T)])
        for i in steps
        for j in steps
        for k in steps
    )
    return Measure(2.0 * int(max(hits)) / int(size))


def _distances(truth: Skeleton, predicted: Skeleton | None) -> tuple[Array, Array] | str:
    """Distances of truth voxels to the prediction and back, mm; or why there are none."""
    from scipy.spatial import cKDTree

    if predicted is None:
        return "no prediction"
    if not len(truth.index):
        return "truth is empty"
    if not len(predicted.index):
        return "prediction is empty"
    to_predicted = cKDTree(predicted.points_mm).query(truth.points_mm)[0]
    to_truth = cKDTree(truth.points_mm).query(predicted.points_mm)[0]
    return to_predicted, to_truth


def _unusable(truth: Array, predicted: Array | None) -> str | None:
    if predicted is None:
        return "no prediction"
    empty = [not truth.any(), not predicted.any()]
    if all(empty):
        return "truth and prediction are empty"
    return "truth is empty" if empty[0] else "prediction is empty" if empty[1] else None


def _same_shape(truth: Array, predicted: Array | None) -> None:
    if predicted is not None and truth.shape != predicted.shape:
        raise ValueError(f"truth is {truth.shape}, prediction {predicted.shape}: not one grid")
