"""Types that options of several verbs share: counts, numbers, places to write to."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import click

from gcar_deploy.errors import UsageError

#: how many; a seed of numpy's generators
COUNT, SEED = click.IntRange(1), click.IntRange(0)


class Number(click.FloatRange):
    """A number within a range, which NaN and infinity are not."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the number, or say what is wrong with it."""
        found = super().convert(value, param, ctx)
        if not math.isfinite(found):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return found


#: minutes, seconds: some
DURATION = Number(0, min_open=True)
RATE = Number(0, 1, min_open=True)


class Out(click.Path):
    """A folder (or, with ``file``, a file) that can be written; nothing is made yet."""

    def __init__(self, *, file: bool = False) -> None:
        super().__init__(path_type=Path)
        self._file = file

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the path.

        Raises
        ------
        UsageError
            It is of the other kind, lies below a file, or where nothing may be written.
        """
        path: Any = super().convert(value, param, ctx)
        what = param.get_error_hint(ctx).strip("'\"") if param else "out"
        if self._file and path.is_dir():
            raise UsageError(f"{what} {path} is a folder: name a file")
        place = path.parent if self._file else path
        while not place.exists():
            place = place.parent
        if not place.is_dir():
            raise UsageError(f"{what} {path}: {place} is a file, not a folder")
        if not os.access(place, os.W_OK):
            raise UsageError(f"{what} {path}: nothing may be written in {place}")
        return path


OUT_FOLDER, OUT_FILE = Out(), Out(file=True)
