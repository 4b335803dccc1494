"""Scenes in the order of their numbers, drawn ahead by other processes where asked."""

from __future__ import annotations

import collections
import concurrent.futures
import contextlib
import itertools
import multiprocessing
import signal
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")


class Terminated(KeyboardInterrupt):
    """SIGTERM ended a training, which is saved."""


#: scenes drawn ahead per worker
AHEAD = 3


@contextlib.contextmanager
def in_order(
    draw: Callable[[int], T], numbers: Iterable[int], workers: int
) -> Iterator[Iterator[T]]:
    """Give an iterator over ``draw(i)`` for every i of ``numbers``, in order.

    Parameters
    ----------
    draw : a function of the number alone, picklable where there are workers
    numbers : may be endless
    workers : processes that draw ahead; 0 draws here, when asked
    """
    if workers == 0:
        yield map(draw, numbers)
        return
    spawn = multiprocessing.get_context("spawn")
    pool = concurrent.futures.ProcessPoolExecutor(
        workers, mp_context=spawn, initializer=leave_interrupts_to_the_parent
    )
    try:
        yield _ahead(pool, draw, iter(numbers), AHEAD * workers)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def leave_interrupts_to_the_parent(*_: object) -> None:
    """Ignore Ctrl-C and SIGTERM here: the process that started this one ends it when all is saved.

    Both may be sent to all processes of a run at once.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def _ahead(
    pool: concurrent.futures.Executor, draw: Callable[[int], T], numbers: Iterator[int], most: int
) -> Iterator[T]:
    waiting = collections.deque(pool.submit(draw, i) for i in itertools.islice(numbers, most))
    while waiting:
        found = waiting.popleft().result()
        waiting.extend(pool.submit(draw, i) for i in itertools.islice(numbers, 1))
        yield found
