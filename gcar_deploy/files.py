"""Files by name and content: read once, with a limit, written whole; no pipe or device is read."""

from __future__ import annotations

import codecs
import contextlib
import fnmatch
import hashlib
import os
import re
import stat
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

_DIGITS = re.compile(r"(\d+)")
_BLOCK = 2**20
#: what files of a folder are called that are the frames of a run
_FRAMES = (".png", ".tif", ".tiff", ".npy")
#: what desktops leave in every folder that is looked at
LEFT_BY_DESKTOPS = (".DS_Store", "Thumbs.db", "desktop.ini")


def natural_order(path: Path) -> list[tuple[int, int, str]]:
    """Sort key of a file by its name: frame 2 goes before frame 10."""
    parts = _DIGITS.split(path.name)
    return [(1, int(p), "") if k % 2 else (0, 0, p) for k, p in enumerate(parts)]


def read_bounded(path: str | Path, max_bytes: int) -> bytes:
    """Return the bytes of a regular file that is not empty.

    Parameters
    ----------
    path : str or Path
    max_bytes : int
        A larger file is refused before it is read.

    Raises
    ------
    ValueError
        The end of a sentence that the caller begins with the file's name.
    """
    with _opened(path, max_bytes) as (stream, size):
        # No more than the file holds is asked for: a limit is no reason to allocate.
        data = stream.read(size + 1)
    if len(data) > size:
        raise ValueError("grew while it was read; try again when it is complete")
    if not data:
        raise ValueError("is empty; copy or export it again")
    return data


def is_folder(path: str | Path) -> bool:
    """Whether there is a folder; False for what cannot be looked at: who opens it says why."""
    # Path.is_dir raises where a folder on the way may not be entered, or a name is too long.
    return os.path.isdir(path)


def is_file(path: str | Path) -> bool:
    """Whether there is a file; as ``is_folder``."""
    return os.path.isfile(path)


def is_there(path: str | Path) -> bool:
    """Whether there is a file or folder; as ``is_folder``."""
    return os.path.exists(path)


def is_free(folder: Path, left: Sequence[str] = ()) -> bool:
    """Whether nothing of anybody's is in a folder: there is none, or it is empty.

    Parameters
    ----------
    left : patterns of names that count as nothing: what the caller may have left there itself
    """
    ours = (*LEFT_BY_DESKTOPS, *left)
    return not is_there(folder) or all(
        any(fnmatch.fnmatchcase(path.name, one) for one in ours) for path in folder.iterdir()
    )


def check_opens(path: str | Path) -> None:
    """Refuse what is no file that can be opened and read.

    Raises
    ------
    ValueError
        As ``read_bounded``.
    """
    with _opened(path, sys.maxsize) as (stream, _):
        stream.read(1)


def digest_of(path: Path, max_bytes: int, max_frames: int) -> bytes:
    """SHA-256 of a file, or of the frames of a folder by name and content.

    Parameters
    ----------
    max_bytes : a larger file counts as one that cannot be read, all of which are equal
    max_frames : no more frames of a folder are read
    """
    digest = hashlib.sha256()
    try:
        if is_folder(path):
            for frame in frames_in(path)[:max_frames]:
                digest.update(os.fsencode(frame.name) + b"\0" + digest_of(frame, max_bytes, 0))
            return digest.digest()
        with _opened(path, max_bytes) as (stream, size):
            # A file that grows meanwhile is not followed.
            for _ in range(0, size, _BLOCK):
                digest.update(stream.read(_BLOCK))
    except (OSError, ValueError):
        return b"absent"
    return digest.digest()


def frames_in(folder: Path) -> list[Path]:
    """Return the pictures of a folder in the order of the numbers in their names.

    Raises
    ------
    ValueError
        As ``read_bounded``.
    """
    try:
        files = [path for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        raise ValueError(f"cannot be read ({error.strerror})") from None
    return sorted((p for p in files if p.suffix.lower() in _FRAMES), key=natural_order)


def path_of(value: object, what: str, error: type[Exception]) -> Path:
    """Return what names a file or folder; empty text does not, though ``Path`` takes it for ".".

    Raises
    ------
    error
        The sentence begins with ``what``.
    """
    if not isinstance(value, (str, os.PathLike)):
        raise error(f"{what} is a {type(value).__name__}; give a path")
    if not os.fspath(value):
        raise error(f"{what} is empty text; name a file or folder")
    if "\0" in os.fsdecode(value):
        raise error(f"{what} {os.fsdecode(value)!r} holds a NUL character, which no name has")
    return Path(value)


@contextlib.contextmanager
def _opened(path: str | Path, max_bytes: int) -> Iterator[tuple[IO[bytes], int]]:
    """Open a regular file that is not too large; yields it with its size."""
    try:
        # O_NONBLOCK: a named pipe must be refused, not waited for.
        handle = os.open(
            path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        )
    except FileNotFoundError:
        raise ValueError("no such file; check the path") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "invalid path"
        raise ValueError(f"cannot be opened ({reason}); check the path") from None
    try:
        # before fdopen, which takes no folders
        info = os.fstat(handle)
        if not stat.S_ISREG(info.st_mode):
            raise ValueError("is not a regular file; give the file itself")
        stream = os.fdopen(handle, "rb")
    except ValueError:
        os.close(handle)
        raise
    with stream:
        if info.st_size > max_bytes:
            raise ValueError(
                f"is larger than the {_size(max_bytes)} that are read ({_size(info.st_size)})"
            )
        try:
            yield stream, info.st_size
        except OSError as error:
            raise ValueError(f"cannot be read ({error.strerror}); check the path") from None


def read_text(path: str | Path, max_bytes: int) -> str:
    """Return the text of a file; see ``read_bounded`` and ``text_of``."""
    return text_of(read_bounded(path, max_bytes))


def text_of(data: bytes) -> str:
    """Decode UTF-8, or UTF-16 behind its mark, as editors and shells of Windows write it.

    Raises
    ------
    ValueError
        The end of a sentence that the caller begins with the file's name.
    """
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        return data.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"is not {'UTF-16' if wide else 'UTF-8'} text") from None


def _size(count: int) -> str:
    return f"{count / 2**20:.4g} MiB" if count >= 2**20 else f"{count / 2**10:.4g} KiB"


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a place beside ``path`` to write to, which takes its place when all is written.

    Nothing stays there where that fails, as on a full disk.

    Raises
    ------
    OSError
        It cannot be written; ``filename`` is the path.
    """
    # Two processes may draw the same picture.
    partial = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        yield partial
        partial.replace(path)
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(partial), partial):
            raise
        # What fails at writing knows no name of the file.
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
