"""Work beside other work: parts of one reconstruction in threads, as many as the caller allows.

What each part gives does not depend on it: threads change when something is worked out, not how.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import TypeVar

T = TypeVar("T")

#: of the calling thread alone: an engine's callers do not see each other's
_ALLOWED: ContextVar[int] = ContextVar("gcar_threads", default=1)


@contextlib.contextmanager
def allowed_threads(count: int) -> Iterator[None]:
    """Let work go beside other work, on up to ``count`` threads, until the end of the block."""
    token = _ALLOWED.set(count)
    try:
        yield
    finally:
        _ALLOWED.reset(token)


def started(work: Callable[[], T]) -> Callable[[], T]:
    """Begin ``work`` beside what follows; at once where one thread is all.

    Returns
    -------
    what waits for the outcome; it raises what the work raised
    """
    if _ALLOWED.get() < 2:
        done = work()
        return lambda: done
    pool = ThreadPoolExecutor(1, "gcar-beside")
    waiting = pool.submit(work)
    pool.shutdown(wait=False)
    return waiting.result


@contextlib.contextmanager
def waited_for(outcome: Callable[[], T]) -> Iterator[Callable[[], T]]:
    """Let what was ``started`` end before an error of the block does: nobody will ask for it."""
    try:
        yield outcome
    except BaseException:
        with contextlib.suppress(Exception):
            outcome()
        raise


def side_by_side(works: Sequence[Callable[[], T]]) -> list[T]:
    """Do independent works on as many threads as are allowed; outcomes in their order."""
    count = min(_ALLOWED.get(), len(works))
    if count < 2:
        return [work() for work in works]
    with ThreadPoolExecutor(count, "gcar-beside") as pool:
        return list(pool.map(lambda work: work(), works))
