"""What options of several verbs share: counts, numbers, places to read and to write."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import click

from gcar_deploy.errors import UsageError

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)
#: how many: some, or none as well; a seed of numpy's generators
COUNT, FROM_ZERO = click.IntRange(1), click.IntRange(0)
SEED = FROM_ZERO


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


def counted(name: str, default: int, text: str, kind: click.IntRange = COUNT) -> Any:
    """Declare an option that is a whole number, and shows its default."""
    return click.option(name, type=kind, default=default, show_default=True, help=text)


def taking(*options: Any) -> Any:
    """Give a verb options that it shares with others, in this order."""

    def taken(command: Any) -> Any:
        for option in reversed(options):
            command = option(command)
        return command

    return taken
