"""The cheapest course of a line through depth: what each place costs, and what turning costs."""

from __future__ import annotations

import math

import numpy as np

from gcar_deploy.types import Array, Scalars

#: slopes that a course may have: whole depth steps per place, to either side
MOST_SLOPE = 10
#: by so many of them a slope may change from one place to the next
MOST_CHANGE = 3


def cheapest_course(
    cost: Array, start: Scalars, depth_step: float, place_step: float, turn: float
) -> tuple[Array, float]:
    """Find the depth of each place so that places, length and turns together cost least.

    Dynamic programming over (depth, slope); exact for the slopes and changes that are allowed.

    Parameters
    ----------
    cost : (n, d) of each place at each depth, for a course that keeps its depth; a steeper one is
        longer and costs more in proportion
    start : (d,) of beginning at each depth, at the first place
    depth_step, place_step : from one depth, and from one place, to the next, mm
    turn : random walk of the direction, 1 / sqrt(mm): half the square of a turn in its units
        is what the turn costs

    Returns
    -------
    depth : (n,) int
    total : float
    """
    places, depths = cost.shape
    slopes = np.arange(-MOST_SLOPE, MOST_SLOPE + 1)
    numbers = np.arange(len(slopes))
    rise = slopes * depth_step / place_step
    angle, longer = np.arctan(rise), np.sqrt(1.0 + rise * rise)
    # Column ``number`` of a beam so padded is the slope that is ``MOST_CHANGE`` less.
    beside = np.pad(angle, MOST_CHANGE, constant_values=math.inf)
    turns = [
        0.5 * (beside[k : k + len(slopes)] - angle) ** 2 / (turn * turn * place_step)
        for k in range(2 * MOST_CHANGE + 1)
    ]
    source = np.arange(depths)[:, None] - slopes
    outside = (source < 0) | (source >= depths)
    flat = np.clip(source, 0, depths - 1) * len(slopes) + numbers
    # Any slope is as good as another to begin with.
    value = np.repeat((cost[0] + start)[:, None], len(slopes), axis=1)
    padded = np.full((depths, len(beside)), math.inf)
    before: list[Array] = []
    for place in range(1, places):
        padded[:, MOST_CHANGE:-MOST_CHANGE] = value
        least = padded[:, : len(slopes)] + turns[0]
        best = np.zeros(value.shape, np.int64)
        for k, turning in enumerate(turns[1:], start=1):
            way = padded[:, k : k + len(slopes)] + turning
            better = way < least
            np.copyto(least, way, where=better)
            np.copyto(best, k, where=better)
        value = least.take(flat) + cost[place][:, None] * longer
        value[outside] = math.inf
        before.append(best.take(flat) + numbers - MOST_CHANGE)
    depth, number = (int(k) for k in np.unravel_index(value.argmin(), value.shape))
    total = float(value[depth, number])
    course = [depth]
    for came in reversed(before):
        depth, number = depth - slopes[number], int(came[depth, number])
        course.append(depth)
    return np.array(course[::-1]), total
