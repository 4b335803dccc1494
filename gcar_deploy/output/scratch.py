"""Private folders beside a result, and the sweeping of those whose owner was killed.

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
_PREFIX = ".gcar-save-"
_NAME = re.compile(re.escape(_PREFIX) + r"[a-z0-9_]{8}")
#: what a scratch folder may hold: the folder being written, and the one that it replaces
FRESH, OLD = "new", "old"


@contextlib.contextmanager
def scratch_folder(parent: Path) -> Iterator[Path]:
    """Make a temporary folder in ``parent``; it is removed at the end, also on an interrupt."""
    scratch, handle = _locked(parent)
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        if handle is not None:
            os.close(handle)


def sweep(parent: Path) -> int:
    """Remove scratch folders in ``parent`` whose owner is dead; return how many.

    A folder that holds both the new and the replaced result is kept: its owner died between
    two renames, and it is the only place where they are.
    """
    if fcntl is None:
        return 0
    swept = 0
    with contextlib.suppress(OSError):
        for path in list(parent.iterdir()):
            if _NAME.fullmatch(path.name) and _sweep_one(path):
                swept += 1
    if swept:
        _log.info("removed %d unfinished folders of runs that were killed", swept)
    return swept


def _locked(parent: Path) -> tuple[Path, int | None]:
    """Make a folder and lock it; a sweeper that comes in between makes another try needed."""
    while True:
        scratch = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=parent))
        if fcntl is None:
            return scratch, None
        handle = os.open(scratch, os.O_RDONLY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            if _same(handle, scratch):
                return scratch, handle
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
