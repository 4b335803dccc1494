"""What several verbs share: logging, the progress bar, options."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import logging
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import IO, TYPE_CHECKING, Any, TypeVar

import click

from gcar_deploy.cli.paths import MODEL
from gcar_deploy.engine_choice import EngineChoice

if TYPE_CHECKING:
    from pathlib import Path

    from gcar_deploy.errors import GcarError

_Function = TypeVar("_Function", bound=Callable[..., Any])
_WIDTH = 28
#: nothing is drawn for work that is over sooner
_PATIENCE_S = 1.0
#: exit code of a refusal by the quality gate
REFUSED = 6


def say(text: str, *, nl: bool = True) -> None:
    """Write to stderr; where nobody can read it, what is done and its exit code stay the same."""
    try:
        click.echo(text, err=True, nl=nl)
    except (OSError, ValueError):
        silence(sys.stderr)


def silence(stream: IO[str]) -> None:
    """Let a stream that cannot be written lead nowhere: Python would try once more at exit."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


class ProgressBar:
    """One line on stderr for anything over a second; silent unless stderr is a terminal."""

    def __init__(self, *, quiet: bool) -> None:
        self._on = not quiet and sys.stderr.isatty()
        self._start = time.monotonic()
        self._drawn = False

    def __call__(self, stage: str, share: float) -> None:
        """Draw the bar at ``share`` of the work (0 .. 1)."""
        if not self._on or time.monotonic() - self._start < _PATIENCE_S:
            return
        full = round(share * _WIDTH)
        bar = "#" * full + "-" * (_WIDTH - full)
        say(f"\r[{bar}] {share:4.0%} {stage:<12}", nl=False)
        self._drawn = True

    def close(self) -> None:
        """Wipe the line."""
        if self._drawn:
            say("\r" + " " * (_WIDTH + 24) + "\r", nl=False)
            self._drawn = False

    def __enter__(self) -> ProgressBar:
        """Return the bar; it is wiped at the end, also after an error."""
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@dataclasses.dataclass(frozen=True)
class Talk:
    """How much a verb says, and in which form."""

    verbose: bool = False
    quiet: bool = False
    as_json: bool = False

    def set_up(self) -> None:
        """Messages of the package go to stderr: all with -v, errors alone with --quiet."""
        level = logging.DEBUG if self.verbose else logging.ERROR if self.quiet else logging.WARNING
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(logging.Formatter("gcar: %(message)s"))
        logger = logging.getLogger("gcar_deploy")
        logger.handlers[:] = [handler]
        logger.setLevel(level)
        logger.propagate = False

    def bar(self) -> ProgressBar:
        """Return a progress bar, silent where that is wanted."""
        return ProgressBar(quiet=self.quiet)

    def note(self, lines: Iterable[str]) -> None:
        """Say sentences on stderr, unless quiet."""
        for line in () if self.quiet else lines:
            say(f"gcar: {line}")


class ToldError(Exception):
    """An error that what stands on stdout tells already."""

    def __init__(self, error: GcarError) -> None:
        self.error = error


def say_failure(sentence: str, exit_code: int) -> None:
    """Print the object that ``--json`` promises where there is no result."""
    found = {
        "schema": "gcar-result/1",
        "status": "refused" if exit_code == REFUSED else "failed",
        "sentence": sentence,
        "exit_code": exit_code,
    }
    try:
        click.echo(json.dumps(found))
    except OSError:
        silence(sys.stdout)


def say_result(text: str, folder: Path) -> None:
    """Print what a result is.

    Raises
    ------
    GcarError
        Nobody could read it; the result stays, and the error tells where.
    """
    from gcar_deploy.errors import GcarError

    try:
        try:
            click.echo(text)
        except UnicodeEncodeError as error:
            # A path in letters that the output has none for: what is told is told all the same.
            click.echo(text.encode(error.encoding, "backslashreplace").decode(error.encoding))
    except BrokenPipeError:
        raise
    except OSError as error:
        reason = error.strerror or error
        raise GcarError(
            f"standard output cannot be written ({reason}); the result lies in {folder}"
        ) from None


def talk_options(*wanted: str) -> Callable[[_Function], Any]:
    """Add --verbose, --quiet, --json (all, or those named); they come as the argument ``talk``."""
    known = {
        "as_json": click.option(
            "--json", "as_json", is_flag=True, help="Print one JSON object on stdout."
        ),
        "quiet": click.option("--quiet", is_flag=True, help="Neither progress nor warnings."),
        "verbose": click.option("-v", "--verbose", is_flag=True, help="Say more on stderr."),
    }
    return gathered("talk", Talk, {k: o for k, o in known.items() if k in wanted or not wanted})


def engine_options(function: _Function) -> Any:
    """Add the models and --threads; they come as the argument ``engine``."""
    known = {
        "threads": click.option("--threads", type=click.IntRange(1, 256), help="At most so many."),
        "segmenter_model": segmenter_option,
        "model": click.option(
            "--model", type=MODEL, help="Predictor as an ONNX file; spec beside it."
        ),
    }
    return gathered("engine", EngineChoice, known)(function)


segmenter_option = click.option(
    "--segmenter-model",
    type=MODEL,
    help="What finds vessels in raw pictures, as an ONNX file; spec beside it.",
)


def gathered(
    name: str, make: Callable[..., Any], options: Mapping[str, Callable[[Any], Any]]
) -> Callable[[_Function], Any]:
    """Add options whose values come as one argument ``name``, made by ``make``."""

    def decorate(function: _Function) -> Any:
        @functools.wraps(function)
        def wrapper(**values: Any) -> Any:
            own = {key: values.pop(key) for key in options}
            return function(**{name: make(**own)}, **values)

        command: Any = wrapper
        for option in options.values():
            command = option(command)
        return command

    return decorate


@contextlib.contextmanager
def until_stopped() -> Iterator[None]:
    """Take Ctrl-C for the end of a service, not for an error."""
    try:
        yield
    except KeyboardInterrupt:
        say("gcar: stopping")


def serve_until_stopped(server: Any) -> None:
    """Run a server of ``worker.loopback`` until Ctrl-C; its port is free afterwards.

    Asked twice, it leaves the port to the end of the process: requests may still be answered.
    """
    with until_stopped():
        server.run()
        server.close()


@contextlib.contextmanager
def needs_extra(extra: str, *packages: str) -> Iterator[None]:
    """Turn a missing library of an extra into one line that says what to install.

    Raises
    ------
    UsageError
        One of ``packages`` is not installed.
    """
    from gcar_deploy.errors import UsageError

    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in packages:
            raise
        raise UsageError(f"{error.name} is not installed: pip install 'gcar[{extra}]'") from None
