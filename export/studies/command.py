"""Command line of the studies: how many scenes of which seed, a bar, a table."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from typing import TypeVar

import click

from gcar_deploy.errors import GcarError

Row = TypeVar("Row")


def ended(main: Callable[[], int | None]) -> int:
    """Run the command of a study; return its exit code. What is wrong is one line on stderr."""
    try:
        return main() or 0
    except GcarError as error:
        click.echo(f"error: {error}", err=True)
        return error.exit_code
    except OSError as error:
        click.echo(
            f"error: {error.filename or 'cannot write'}: {error.strerror or error}", err=True
        )
        return 1


def arguments(text: str | None, option: str, count: int, seed: int) -> argparse.ArgumentParser:
    """Parser of a study ``text`` is the help of; ``option`` says how many scenes there are."""
    parser = argparse.ArgumentParser(description=text)
    parser.add_argument(option, type=int, default=count)
    parser.add_argument("--seed", type=int, default=seed)
    return parser


def print_table(rows: Iterable[Row], count: int, table: Callable[[list[Row]], str]) -> None:
    """Make ``count`` rows under a progress bar on stderr, and print what they come to."""
    with click.progressbar(rows, length=count, file=sys.stderr) as bar:
        print(table(list(bar)))
