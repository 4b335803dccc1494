"""Private folders for the files of orders; not even a killed worker leaves one for good."""

from __future__ import annotations

import tempfile
from pathlib import Path

from gcar_deploy.scratch import WORKER, drop, held_folder, sweep

#: what holds each folder as long as this process lives
_held: dict[Path, int | None] = {}


def new_scratch() -> Path:
    """Make a folder that only this user may read."""
    folder, handle = held_folder(Path(tempfile.gettempdir()), WORKER)
    _held[folder] = handle
    return folder


def drop_scratch(folder: Path) -> None:
    """Remove a folder with all that is in it."""
    drop(folder, _held.pop(folder, None))


def drop_all_scratch() -> None:
    """Remove every folder of this process, also those of jobs that still run."""
    for folder in list(_held):
        drop_scratch(folder)


def sweep_scratch() -> int:
    """Remove the folders of workers that were killed; return how many."""
    return sweep(Path(tempfile.gettempdir()), WORKER)
