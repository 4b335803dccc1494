"""Private folders for what is not finished, and the sweeping of those whose owner was killed.

The owner holds a lock on its folder as long as it lives; the system takes the lock away with
the process, however it ends. So a folder that can be locked is nobody's any more.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

try:
    import fcntl as _fcntl
except ImportError:  # no such locks on this system: nothing is swept there
    fcntl: Any = None
else:
    fcntl = _fcntl

_log = logging.getLogger(__name__)
#: of a folder beside a result, and of one that holds the files of a worker's order
SAVE, WORKER = ".gcar-save-", "gcar-worker-"
#: what a folder beside a result may hold: the folder being written, and the one that it replaces
FRESH, OLD = "new", "old"


@contextlib.contextmanager
def scratch_folder(parent: Path) -> Iterator[Path]:
    """Make a folder beside a result; it is removed at the end, also on an interrupt."""
    scratch, handle = held_folder(parent, SAVE)
    try:
        yield scratch
    finally:
        drop(scratch, handle)


def drop(scratch: Path, handle: int | None) -> None:
    """Remove a folder that is held, and let it go."""
    shutil.rmtree(scratch, ignore_errors=True)
    if handle is not None:
        os.close(handle)


def sweep(parent: Path, prefix: str = SAVE) -> int:
    """Remove folders in ``parent`` whose owner is dead; return how many.

    A folder that holds both the new and the replaced result is kept: its owner died between
    two renames, and it is the only place where they are.
    """
    if fcntl is None:
        return 0
    swept = 0
    with contextlib.suppress(OSError):
        for path in list(parent.iterdir()):
            if re.fullmatch(re.escape(prefix) + "[a-z0-9_]{8}", path.name) and _sweep_one(path):
                swept += 1
    if swept:
        _log.info("removed %d unfinished folders of runs that were killed", swept)
    return swept


def held_folder(parent: Path, prefix: str) -> tuple[Path, int | None]:
    """Make a folder that only this user may read, and lock it.

    Returns
    -------
    the folder, and what holds the lock until it is closed (None where there are no locks)
    """
    while True:
        scratch = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
        if fcntl is None:
            return scratch, None
        handle = os.open(scratch, os.O_RDONLY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            if _same(handle, scratch):
                return scratch, handle
            # A sweeper came in between.
        except OSError:  # a file system without locks: no one can sweep there either
            os.close(handle)
            return scratch, None
        os.close(handle)


def _sweep_one(path: Path) -> bool:
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_DIRECTORY)
    except OSError:
        return False
    try:
        info = os.fstat(handle)
        if info.st_uid != os.getuid() or stat.S_IMODE(info.st_mode) & 0o077:
            return False
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not _same(handle, path) or {FRESH, OLD} <= set(os.listdir(path)):
            return False
        shutil.rmtree(path, ignore_errors=True)
        return not path.exists()
    except OSError:
        return False
    finally:
        os.close(handle)


def _same(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), os.lstat(path))
    except OSError:
        return False
