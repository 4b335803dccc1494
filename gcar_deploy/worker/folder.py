"""The one folder that a worker may touch: no way out by ``..``, absolute paths or links."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from gcar_deploy.config import DicomLimits
from gcar_deploy.errors import UsageError
from gcar_deploy.files import is_folder

#: a file larger than this is not copied: no reader takes one
MAX_BYTES = DicomLimits.max_bytes


class AllowedFolder:
    """Reads and names files below one folder; every step of a path is checked as it is opened.

    Parameters
    ----------
    root : existing folder; may itself be reached through links

    Raises
    ------
    UsageError
        There is no such folder.
    """

    def __init__(self, root: Path) -> None:
        if not is_folder(root):
            raise UsageError(f"{root} is not a folder")
        self.root = root.resolve()

    def parts(self, name: str) -> tuple[str, ...]:
        """Split a relative path.

        Raises
        ------
        UsageError
            It is absolute, empty, or holds ``..``, a NUL, a backslash or a drive.
        """
        path = PurePosixPath(name)
        bad = not name or path.is_absolute() or not path.parts or ".." in path.parts
        bad |= any(len(part.encode("utf-8", "backslashreplace")) > 255 for part in path.parts)
        bad |= len(name) > 1024 or not name.isprintable()
        if bad or any(mark in name for mark in ("\0", "\\", ":")):
            raise UsageError(f"path {name[:80]!r}: give a path inside the worker's folder")
        return path.parts

    def copy(self, name: str, target: Path) -> Path:
        """Copy a regular file out of the folder.

        Later changes of the file, or a link put in its place, change nothing any more.

        Raises
        ------
        UsageError
            There is no such file, a part of the path is a link, or it is too large.
        """
        parts = self.parts(name)
        try:
            with self._opened(parts) as source:
                found = os.fstat(source)
                if not stat.S_ISREG(found.st_mode):
                    raise UsageError(f"path {name!r}: not a regular file")
                if found.st_size > MAX_BYTES:
                    raise UsageError(f"path {name!r}: larger than {MAX_BYTES >> 20} MiB")
                with (
                    os.fdopen(os.dup(source), "rb") as reader,
                    open(target, "xb") as writer,
                ):
                    shutil.copyfileobj(reader, writer)
        except FileNotFoundError:
            raise UsageError(f"path {name!r}: no such file in the worker's folder") from None
        except OSError as error:
            # ELOOP and ENOTDIR are what O_NOFOLLOW makes of a link.
            raise UsageError(
                f"path {name!r}: not allowed or not readable ({error.strerror})"
            ) from None
        return target

    def target(self, name: str) -> Path:
        """Return where a result folder may be made.

        Raises
        ------
        UsageError
            The path leaves the folder, or a part of it is a link.
        """
        path = self.root
        for part in self.parts(name):
            path = path / part
            if path.is_symlink():
                raise UsageError(f"path {name!r}: {part} is a link; links are not followed")
        return path

    def inside(self, text: str) -> str:
        """Name paths in a text as orders do, without what leads to the folder."""
        if self.root == self.root.parent:
            return text
        # Where a word begins: a folder of the same name may lie further inside.
        root = r"(?<!\S)" + re.escape(str(self.root))
        return re.sub(root + r"(?!\S)", "the folder", re.sub(root + re.escape(os.sep), "", text))

    @contextlib.contextmanager
    def _opened(self, parts: tuple[str, ...]) -> Iterator[int]:
        """File descriptor of a file, reached step by step without following links."""
        if os.open not in os.supports_dir_fd:
            # Windows: checked by name; making links there needs a privilege.
            path = self.target("/".join(parts))
            yield from self._closing(os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0)))
            return
        handle = os.open(self.root, os.O_RDONLY | os.O_DIRECTORY)
        try:
            for part in parts[:-1]:
                flags = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW
                deeper = os.open(part, flags, dir_fd=handle)
                os.close(handle)
                handle = deeper
            # O_NONBLOCK: a named pipe must be refused, not waited for.
            flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
            yield from self._closing(os.open(parts[-1], flags, dir_fd=handle))
        finally:
            os.close(handle)

    @staticmethod
    def _closing(handle: int) -> Iterator[int]:
        try:
            yield handle
        finally:
            os.close(handle)
