"""What several verbs share: logging, the progress bar, the options of a reconstruction."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import click

_Function = TypeVar("_Function", bound=Callable[..., Any])
_WIDTH = 28
#: nothing is drawn for work that is over sooner
_PATIENCE_S = 1.0


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
        click.echo(f"\r[{bar}] {share:4.0%} {stage:<12}", err=True, nl=False)
        self._drawn = True

    def close(self) -> None:
        """Wipe the line."""
        if self._drawn:
            click.echo("\r" + " " * (_WIDTH + 24) + "\r", err=True, nl=False)
            self._drawn = False

    def __enter__(self) -> ProgressBar:
        """Return the bar; it is wiped at the end, also after an error."""
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def set_up_logging(verbose: bool, quiet: bool) -> None:
    """Messages of the package go to stderr: all with -v, errors alone with --quiet."""
    level = logging.DEBUG if verbose else logging.ERROR if quiet else logging.WARNING
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("gcar: %(message)s"))
    logger = logging.getLogger("gcar_deploy")
    logger.handlers[:] = [handler]
    logger.setLevel(level)
    logger.propagate = False


def limit_threads(threads: int | None) -> None:
    """Hold every numerical library of this process to ``threads``; before they are imported."""
    if threads is None:
        return
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(threads)
    import cv2

    cv2.setNumThreads(threads)


def output_options(function: _Function) -> _Function:
    """Add -v, --quiet and --json."""
    for option in (
        click.option("--json", "as_json", is_flag=True, help="Print one JSON object on stdout."),
        click.option("--quiet", is_flag=True, help="Neither progress nor warnings."),
        click.option("-v", "--verbose", is_flag=True, help="Say more on stderr."),
    ):
        function = option(function)
    return function


def engine_options(function: _Function) -> _Function:
    """Add the options that choose how a tree is reconstructed, and for how long."""
    deadline = click.option(
        "--deadline",
        type=click.FloatRange(min=0, min_open=True),
        default=None,
        metavar="SECONDS",
        help="End the refinement with what it has after so long.",
    )
    return predictor_options(deadline(function))


def predictor_options(function: _Function) -> _Function:
    """Add the options that choose how a tree is reconstructed."""
    for option in (
        click.option(
            "--threads", type=click.IntRange(1, 256), default=None, help="At most so many."
        ),
        click.option(
            "--refiner",
            type=click.Choice(["tube", "paper", "none"]),
            default="tube",
            show_default=True,
            help="How the tree is fitted to the pictures.",
        ),
        click.option("--model", type=click.Path(), default=None, help="ONNX file; spec beside it."),
        click.option(
            "--predictor",
            type=click.Choice(["auto", "multi", "single", "none"]),
            default="auto",
            show_default=True,
            help="Who decides depth: a model, or none (the visual hull is thinned).",
        ),
    ):
        function = option(function)
    return function


def dicom_options(function: _Function) -> _Function:
    """Add what a DICOM file may leave open; arguments ``frame``, ``spacing``, ``sod``."""
    for option in (
        click.option(
            "--sod",
            type=click.FloatRange(300, 5000),
            default=None,
            metavar="MM",
            help="DICOM without it: source to isocentre.",
        ),
        click.option(
            "--pixel-spacing",
            "spacing",
            type=click.FloatRange(0.02, 10),
            default=None,
            metavar="MM",
            help="DICOM without it: pixel spacing at the detector.",
        ),
        click.option(
            "--frame",
            default="auto",
            show_default=True,
            metavar="N|auto",
            help="DICOM: frame of the run, from 1; one for all files, or 7,12 for each.",
        ),
    ):
        function = option(function)
    return function


def chosen_dicom(frame: str, spacing: float | None, sod: float | None) -> Any:
    """Return DicomOptions; a wrong ``--frame`` is a UsageError."""
    from gcar_deploy.config import DicomOptions
    from gcar_deploy.errors import UsageError

    frames: list[int | None] = []
    for word in frame.split(","):
        text = word.strip()
        if text != "auto" and not (text.isascii() and text.isdigit() and len(text) < 7):
            raise UsageError(f"--frame {frame[:40]!r} must be auto, a number, or one for each file")
        frames.append(None if text == "auto" else int(text))
    return DicomOptions(frames=tuple(frames), pixel_spacing_mm=spacing, sod_mm=sod)


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


def backend_options(function: _Function) -> _Function:
    """Add what the paper's refiner computes with."""
    for option in (
        click.option(
            "--backend",
            type=click.Choice(["numpy", "torch"]),
            default="numpy",
            show_default=True,
            help="What the paper's refiner computes with; torch is its twin (extra torch).",
        ),
        click.option(
            "--device",
            type=click.Choice(["cpu", "cuda"]),
            default="cpu",
            show_default=True,
            help="Where torch computes.",
        ),
    ):
        function = option(function)
    return function


@contextlib.contextmanager
def refusals_as_json(wanted: bool) -> Iterator[None]:
    """With --json, a solve that is refused or fails is an object on stdout as well."""
    from gcar_deploy.errors import NumericalError, RefusedError

    try:
        yield
    except (RefusedError, NumericalError) as error:
        if wanted:
            status = "refused" if isinstance(error, RefusedError) else "failed"
            found = {
                "schema": "gcar-result/1",
                "status": status,
                "sentence": str(error),
                "exit_code": error.exit_code,
            }
            click.echo(json.dumps(found))
        raise


def run_options(predictor: str, refiner: str, backend: str = "numpy", device: str = "cpu") -> Any:
    """Return RunOptions with these choices made.

    Raises
    ------
    UsageError
        A backend for a refiner that has only one, or one that is not there.
    """
    import dataclasses

    from gcar_deploy.config import RunOptions
    from gcar_deploy.errors import UsageError

    if (backend, device) != ("numpy", "cpu"):
        if refiner != "paper":
            raise UsageError(
                f"--backend {backend} --device {device} is for --refiner paper; "
                f"the refiner {refiner} computes with numpy on cpu"
            )
        from gcar_deploy.gaussians.backends import backend_named

        backend_named(backend, device)
    options = RunOptions()
    paper = dataclasses.replace(options.refine.paper, backend=backend, device=device)
    return dataclasses.replace(
        options,
        predict=dataclasses.replace(options.predict, predictor=predictor),
        refine=dataclasses.replace(options.refine, refiner=refiner, paper=paper),
    )
