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
    slopes = range(-MOST_SLOPE, MOST_SLOPE + 1)
    numbers = np.arange(len(slopes))
    rise = np.array(slopes) * depth_step / place_step
    angle, longer = np.arctan(rise), np.sqrt(1.0 + rise * rise)
    turns = 0.5 * (angle[:, None] - angle) ** 2 / (turn * turn * place_step)
    turns[np.abs(numbers[:, None] - numbers) > MOST_CHANGE] = math.inf
    # Any slope is as good as another to begin with.
    value = np.repeat((cost[0] + start)[:, None], len(slopes), axis=1)
    before: list[Array] = []
    for place in range(1, places):
        reached = np.full_like(value, math.inf)
        came = np.zeros(value.shape, np.int64)
        for number, slope in enumerate(slopes):
            lowest = max(number - MOST_CHANGE, 0)
            near = slice(lowest, number + MOST_CHANGE + 1)
            ways = value[:, near] + turns[near, number]
            best = ways.argmin(axis=1)
            low = min(max(-slope, 0), depths)
            high = max(depths - max(slope, 0), low)
            to = slice(low + slope, high + slope)
            least = np.take_along_axis(ways, best[:, None], axis=1)[:, 0]
            reached[to, number] = least[low:high] + cost[place, to] * longer[number]
            came[to, number] = best[low:high] + lowest
        value = reached
        before.append(came)
    depth, number = (int(k) for k in np.unravel_index(value.argmin(), value.shape))
    total = float(value[depth, number])
    course = [depth]
    for came in reversed(before):
        depth, number = depth - slopes[number], int(came[depth, number])
        course.append(depth)
    return np.array(course[::-1]), total
