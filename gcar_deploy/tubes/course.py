"""The cheapest course of a line through depth: what each place costs, and what turning costs."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from gcar_deploy.types import Array, Scalars

#: slopes that a course may have: whole depth steps per place, to either side
MOST_SLOPE = 10
#: by so many of them a slope may change from one place to the next
MOST_CHANGE = 3
#: of a course's cost: bounds are its sums in another order
ROUNDING = 1e-9


def cheapest_course(
    cost: Array,
    start: Scalars,
    depth_step: float,
    place_step: float,
    turn: float,
    limit: float = math.inf,
) -> tuple[Array, float] | None:
    """Find the depth of each place so that places, length and turns together cost least.

    Dynamic programming over (depth, slope); exact for the slopes and changes that are allowed.
    Only depths are gone through that a course below the limit can have were its turns free.

    Parameters
    ----------
    cost : (n, d) of each place at each depth, >= 0, for a course that keeps its depth; a steeper
        one is longer and costs more in proportion
    start : (d,) of beginning at each depth, at the first place
    depth_step, place_step : from one depth, and from one place, to the next, mm
    turn : random walk of the direction, 1 / sqrt(mm): half the square of a turn in its units
        is what the turn costs
    limit : no course is asked for that costs more

    Returns
    -------
    depth : (n,) int
    total : float
    or None where all courses cost more than ``limit``
    """
    places, depths = cost.shape
    slopes = np.arange(-MOST_SLOPE, MOST_SLOPE + 1)
    numbers = np.arange(len(slopes))
    rise = slopes * depth_step / place_step
    angle, longer = np.arctan(rise), np.sqrt(1.0 + rise * rise)
    # Column ``number`` of a beam so padded is the slope that is ``MOST_CHANGE`` less.
    beside = np.pad(angle, MOST_CHANGE, constant_values=math.inf)
    turns = np.stack(
        [
            0.5 * (beside[k : k + len(slopes)] - angle) ** 2 / (turn * turn * place_step)
            for k in range(2 * MOST_CHANGE + 1)
        ]
    )
    possible = _possible(cost, start, limit)
    if not possible.any(axis=1).all():
        return None
    rows = np.flatnonzero(possible[0])
    # Any slope is as good as another to begin with.
    value = np.repeat((cost[0] + start)[rows, None], len(slopes), axis=1)
    # Where each depth, and those up to a step's rise beyond all, is among the rows.
    among = np.empty(depths + 2 * MOST_SLOPE, np.int64)
    before: list[tuple[Array, Array]] = []
    for place in range(1, places):
        # The row behind the last stands for all depths that are not possible.
        among.fill(len(rows))
        among[rows + MOST_SLOPE] = np.arange(len(rows))
        padded = np.full((len(rows) + 1, len(beside)), math.inf)
        padded[:-1, MOST_CHANGE:-MOST_CHANGE] = value
        least = padded[:, : len(slopes)] + turns[0]
        for k, turning in enumerate(turns[1:], start=1):
            np.minimum(least, padded[:, k : k + len(slopes)] + turning, out=least)
        rows = np.flatnonzero(possible[place])
        came = among[rows[:, None] - slopes + MOST_SLOPE]
        value = least.take(came * len(slopes) + numbers) + cost[place, rows, None] * longer
        before.append((came, padded))
    row, number = (int(k) for k in np.unravel_index(value.argmin(), value.shape))
    total = float(value[row, number])
    if total > limit:
        return None
    course = [int(rows[row])]
    for came, padded in reversed(before):
        row = int(came[row, number])
        course.append(course[-1] - int(slopes[number]))
        ways = padded[row, number : number + len(turns)] + turns[:, number]
        number += int(ways.argmin()) - MOST_CHANGE
    return np.array(course[::-1]), total


def _possible(cost: Array, start: Scalars, limit: float) -> Array:
    """(n, d) bool: depths of courses that may cost no more than ``limit`` and the best straight."""
    limit = min(limit, float((cost.sum(axis=0) + start).min()))
    onward, back = cost.copy(), cost.copy()
    onward[0] += start
    for place in range(1, len(cost)):
        onward[place] += _least_near(onward[place - 1])
        back[-1 - place] += _least_near(back[-place])
    through: Array = onward + back - cost
    return through <= limit * (1.0 + ROUNDING)


def _least_near(values: Scalars) -> Scalars:
    """(d,) least of the values from which one step leads to each depth."""
    least: Scalars = ndimage.minimum_filter1d(values, 2 * MOST_SLOPE + 1, mode="nearest")
    return least
