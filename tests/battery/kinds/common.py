"""What every kind asserts of a refusal."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

from gcar_deploy.errors import GcarError
from tests.battery.pool import FoundError

#: a refusal is one line of at most so many characters
LONGEST = 600


def generator(kind: str, seed: int, index: int) -> random.Random:
    """Return the generator of one case: a function of kind, seed and index alone."""
    return random.Random(f"{kind}/{seed}/{index}")


def outcome(folder: Path, allowed: tuple[int, ...], work: Callable[[], str]) -> str:
    """Do ``work``; name what came of it.

    Raises
    ------
    FoundError
        A refusal with the wrong code, of several lines or with a path; a file left behind.
    """
    before = sorted(p.name for p in folder.iterdir())
    try:
        found = work()
    except GcarError as error:
        text = str(error)
        if error.exit_code not in allowed:
            raise FoundError(f"exit code {error.exit_code}: {text[:200]}") from None
        if "\n" in text or len(text) > LONGEST or str(folder) in text:
            raise FoundError(f"not one short line without a path: {text[:200]!r}") from None
        found = f"refused {error.exit_code}"
    after = sorted(p.name for p in folder.iterdir())
    if after != before:
        raise FoundError(f"left behind: {sorted(set(after) - set(before))}")
    return found
