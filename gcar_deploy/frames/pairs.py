"""The pair of frames in which both runs show the heart in one phase.

Every plane through both sources cuts the same slice of contrast out of both pictures if they show
the same tree (``geometry.consistency``). What holds for all frames of a run (a catheter, a vessel
whose contrast is misjudged, a branch that one run has not in its picture) makes all profiles of
that run differ alike from those of the other. So the profiles are compared by what sets each apart
from the run's mean: that is the heartbeat, and both runs show the same. The patient may lie
elsewhere in the second run, which shifts all profiles along the planes: the best shift counts.
Frames before and after must agree as well, which tells contraction from filling.
"""

from __future__ import annotations

import numpy as np

from gcar_deploy.frames.masses import RunMasses, plane_profiles
from gcar_deploy.geometry.consistency import BIN_MM
from gcar_deploy.imaging.chosen_frame import FramePair
from gcar_deploy.types import Array, Mask, Scalars

#: frames filled to this share, and the stiller part of them, are taken
FILLED_SHARE, STILL_SHARE = 0.75, 0.75
#: frames filled to this share make the mean of a run; so much of the mean is taken off
_MEAN_FILLED, _MEAN_SHARE = 0.5, 0.9
#: farthest shift between the runs across the planes, and its steps, mm
_REACH_MM, _STEP_MM = 12.0, 0.5
#: frames before and after that must agree as well, the farther the less
_NEIGHBOURS = 3
#: frames of one run whose profiles correlate less show the heart in another shape
_SAME_SHAPE = 0.5


def choose_pair(
    first: RunMasses,
    second: RunMasses,
    *,
    wanted: tuple[int | None, int | None] = (None, None),
    r_waves: tuple[list[int], list[int]] = ([], []),
    ratio: float = 1.0,
) -> FramePair:
    """Hold all frames of two runs against each other and take the pair that agrees best.

    Parameters
    ----------
    first, second : contrast of both runs
    wanted : frame (from 0) of a run that is to be taken whatever is seen, None to choose
    r_waves : frames at an R wave; where both runs have such that are filled, only they are taken
    ratio : frames that the second run takes while the first takes one
    """
    profiles = plane_profiles(first, second)
    moving = [
        profile - _MEAN_SHARE * _mean(profile, run.filling)
        for profile, run in zip(profiles, (first, second), strict=True)
    ]
    scores = along_diagonals(_best_shift(*map(_unit, moving)), ratio)
    usable = [_usable(run) for run in (first, second)]
    at_r = [
        np.isin(np.arange(len(mine)), beats) & (run.filling >= FILLED_SHARE)
        for mine, beats, run in zip(usable, r_waves, (first, second), strict=True)
    ]
    if at_r[0].any() and at_r[1].any():
        usable = at_r
    for k, frame in enumerate(wanted):
        if frame is not None:
            usable[k] = np.arange(len(usable[k])) == frame
    remaining = usable[0][:, None] & usable[1][None]
    masked = np.where(remaining, scores, -np.inf)
    i, j = (int(at) for at in np.unravel_index(int(masked.argmax()), masked.shape))
    shapes = [
        _unit(profile - _mean(profile, run.filling))
        for profile, run in zip(profiles, (first, second), strict=True)
    ]
    others = np.concatenate([
        masked[i, shapes[1] @ shapes[1][j] < _SAME_SHAPE],
        masked[shapes[0] @ shapes[0][i] < _SAME_SHAPE, j],
    ])  # fmt: skip
    rival = float(others.max(initial=-np.inf))
    return FramePair(
        scores=scores, remaining=remaining, chosen=(i, j),
        margin=float(scores[i, j]) - rival if np.isfinite(rival) else None,
        filling=(first.filling, second.filling), motion=(first.motion, second.motion),
    )  # fmt: skip


def along_diagonals(scores: Array, ratio: float) -> Array:
    """(n, m) mean of each score with those of the frames before and after in both runs.

    Parameters
    ----------
    scores : (n, m)
    ratio : columns that belong to a step of one row
    """
    n, m = scores.shape
    total, weights = np.zeros((n, m)), np.zeros((n, m))
    rows, columns = np.arange(n), np.arange(m)
    for step in range(-_NEIGHBOURS, _NEIGHBOURS + 1):
        i, at = rows + step, columns + step * ratio
        low = np.clip(np.floor(at).astype(np.int64), 0, max(m - 2, 0))
        part = np.clip(at - low, 0.0, 1.0)
        high = np.minimum(low + 1, m - 1)
        inside = ((i >= 0) & (i < n))[:, None] & ((at >= 0) & (at <= m - 1))[None]
        own = scores[np.clip(i, 0, n - 1)]
        weight = (1 - abs(step) / (_NEIGHBOURS + 1)) * inside
        total += weight * (own[:, low] * (1 - part) + own[:, high] * part)
        weights += weight
    return total / weights


def _usable(run: RunMasses) -> Mask:
    """(n,) frames with contrast, without those in which the heart moves fastest."""
    filled = run.filling >= FILLED_SHARE
    still = run.motion <= np.quantile(run.motion[filled], STILL_SHARE)
    usable: Mask = filled & still
    return usable


def _best_shift(first: Array, second: Array) -> Array:
    """(n, m) largest correlation of unit profiles over shifts of the second run."""
    best = np.full((len(first), len(second)), -1.0)
    reach = round(_REACH_MM / BIN_MM)
    for bins in range(-reach, reach + 1, round(_STEP_MM / BIN_MM)):
        # Profiles end well within their range: nothing is carried round.
        np.maximum(best, first @ np.roll(second, bins, axis=1).T, out=best)
    return best


def _mean(profiles: Array, filling: Scalars) -> Array:
    mean: Array = profiles[filling >= _MEAN_FILLED].mean(axis=0)
    return mean


def _unit(profiles: Array) -> Array:
    out: Array = profiles / np.maximum(np.linalg.norm(profiles, axis=1, keepdims=True), 1e-12)
    return out
