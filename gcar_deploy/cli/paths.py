"""Paths on the command line.

An empty one, as an unset variable of a script leaves it, would be the working folder to
``Path``. Whether a file may be read is left to who reads it, with the exit code of its kind.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from gcar_deploy.errors import GcarError, GeometryError, ImageError, ModelError, UsageError
from gcar_deploy.files import path_of


class NamedPath(click.Path):
    """Path of anything, there or not; empty text ends with the exit code of ``error``."""

    def __init__(self, error: type[GcarError] = UsageError) -> None:
        super().__init__(readable=False, path_type=Path)
        self._error = error

    def convert(
        self,
        value: str | os.PathLike[str],
        param: click.Parameter | None,
        ctx: click.Context | None,
    ) -> Any:
        """Return the path."""
        path_of(
            value, param.opts[0] if isinstance(param, click.Option) else "the path", self._error
        )
        return super().convert(value, param, ctx)


ANY_PATH = NamedPath()
PICTURE, GEOMETRY, MODEL = (NamedPath(e) for e in (ImageError, GeometryError, ModelError))


def pictures(
    name: str, *, metavar: str | None = None, count: int = -1, required: bool = False
) -> Callable[[Any], Any]:
    """Add an argument of pictures or runs: one Path where ``count`` is 1, else a tuple of them."""
    return click.argument(
        name, nargs=count, required=required or count > 0, type=click.Path(readable=False),
        metavar=metavar, callback=_numbered,
    )  # fmt: skip


def _numbered(
    ctx: click.Context, param: click.Parameter, given: str | tuple[str, ...] | None
) -> Any:
    """Turn text into paths; an empty one is told by the number of its view."""
    texts = (given,) if isinstance(given, str) else given or ()
    paths = tuple(path_of(text, f"view {k}", ImageError) for k, text in enumerate(texts, start=1))
    return paths[0] if isinstance(given, str) else paths
