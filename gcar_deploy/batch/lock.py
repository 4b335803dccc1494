"""One batch, or one training, at a time in a folder."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gcar_deploy.errors import UsageError

#: the byte that is locked: far behind the text, which others may read on every system
_BYTE = 4096


@contextlib.contextmanager
def only_one(what: str, out: Path, file: Path) -> Iterator[None]:
    """Hold the folder ``out`` by a lock on ``file``, which the system takes away with the process.

    ``what`` says who holds it: a batch, a training.

    Raises
    ------
    UsageError
        Another one holds it, or the file cannot be made.
    """
    try:
        handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise UsageError(f"{out} cannot be written ({error.strerror})") from None
    with os.fdopen(handle, "r+", encoding="ascii", errors="replace") as stream:
        if not _locked(stream):
            process = stream.readline(20).strip() or "unknown"
            raise UsageError(
                f"another {what} (process {process}) is at work in {out}; wait for it or choose "
                "another folder"
            )
        stream.truncate()
        stream.write(f"{os.getpid()}\n")
        stream.flush()
        yield


def _locked(stream: Any) -> bool:
    """Lock a file until it is closed; True too where the file system has no locks."""
    try:
        import fcntl
    except ImportError:  # Windows
        import msvcrt

        windows: Any = msvcrt
        stream.seek(_BYTE)
        try:
            windows.locking(stream.fileno(), windows.LK_NBLCK, 1)
        except OSError:
            return False
        finally:
            stream.seek(0)
        return True
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True
