"""The cheapest course through depth against every course there is."""

import itertools

import numpy as np
import pytest

from gcar_deploy.tubes.course import MOST_CHANGE, cheapest_course


def _by_trial(cost, start, depth_step, place_step, turn):
    """Cost of the cheapest of all courses, and the course."""
    best = np.inf, None
    for course in itertools.product(range(cost.shape[1]), repeat=len(cost)):
        steps = np.diff(course)
        if np.abs(np.diff(steps)).max(initial=0) > MOST_CHANGE:
            continue
        turns = np.diff(np.arctan2(steps * depth_step, place_step))
        longer = np.hypot(steps * depth_step, place_step) / place_step
        total = start[course[0]] + cost[0, course[0]]
        total += sum(cost[k + 1, course[k + 1]] * longer[k] for k in range(len(steps)))
        total += 0.5 * np.sum((turns / turn) ** 2 / place_step)
        if total < best[0]:
            best = total, course
    return best


@pytest.mark.parametrize("seed", range(8))
def test_no_course_is_cheaper(seed):
    rng = np.random.default_rng(seed)
    cost, start = 3 * rng.random((5, 6)), 2 * rng.random(6)
    spaces = 0.5, rng.uniform(1.0, 3.0), rng.uniform(0.1, 1.0)
    depth, total = cheapest_course(cost, start, *spaces)
    least, course = _by_trial(cost, start, *spaces)
    assert total == pytest.approx(least)
    np.testing.assert_array_equal(depth, course)


def test_a_straight_corridor_is_followed_through_a_place_that_shows_nothing():
    cost = np.full((12, 60), 4.0)
    corridor = 10 + 3 * np.arange(12)
    cost[np.arange(12), corridor] = 0.0
    cost[6] = 4.0
    depth, total = cheapest_course(cost, np.zeros(60), 0.5, 2.0, 0.15)
    np.testing.assert_array_equal(depth, corridor)
    assert total == pytest.approx(4.0 * np.hypot(1.0, 0.75))


@pytest.mark.parametrize("seed", range(40))
def test_a_limit_leaves_out_what_costs_more_and_nothing_else(seed):
    rng = np.random.default_rng(seed)
    cost, start = rng.gamma(0.5, 2.0, (14, 40)), 20 * rng.random(40)
    spaces = 0.5, 2.0, 0.15
    depth, total = cheapest_course(cost, start, *spaces)
    for share in (1.0, 1.01, 1.5):
        same, again = cheapest_course(cost, start, *spaces, limit=share * total)
        np.testing.assert_array_equal(same, depth)
        assert again == total
    assert cheapest_course(cost, start, *spaces, limit=0.999 * total) is None
    assert cheapest_course(cost, start, *spaces, limit=0.0) is None
