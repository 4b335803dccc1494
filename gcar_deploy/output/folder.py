"""A folder that appears whole or not at all, also when the process is interrupted."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import hashlib
import json
import os
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from gcar_deploy.errors import GcarError, UsageError
from gcar_deploy.files import LEFT_BY_DESKTOPS, read_bounded
from gcar_deploy.scratch import FRESH, OLD, scratch_folder, sweep

_AT_FDCWD = -100
_RENAME_NOREPLACE = 1
_RENAME_EXCHANGE = 2
#: files written at once
_WRITERS = 8

#: the file that lists all others of a folder; the first is what ``gcar run`` writes anyway
MANIFESTS = ("result.json", "manifest.json")
_SCHEMA, _MOST_BYTES = "gcar-folder/1", 2**26


def check_target(out_dir: Path, *, force: bool, inputs: tuple[Path, ...] = ()) -> None:
    """Refuse a folder that must not be written, before any work is done.

    Parameters
    ----------
    out_dir : the folder to be
    force : whether a folder that this program wrote may be replaced; no other ever is
    inputs : files that must not go with it

    Raises
    ------
    UsageError
        ``out_dir`` is a link or a file, exists without ``force``, holds what this program did
        not write, an input or the working folder, or no folder can be made there.
    """
    try:
        linked = out_dir.is_symlink()
    except OSError as error:  # a name that is too long, a folder that may not be entered
        name = out_dir.name if len(out_dir.name) < 80 else out_dir.name[:80] + "..."
        raise UsageError(f"{name} cannot be made ({error.strerror})") from None
    if linked:
        raise UsageError(f"{out_dir} is a symbolic link; name a folder of its own")
    if out_dir.exists():
        _check_existing(out_dir, inputs)
        if not force:
            raise _taken(out_dir)
    ancestor = out_dir.absolute().parent
    while not ancestor.exists() and not ancestor.is_symlink():
        ancestor = ancestor.parent
    if not ancestor.is_dir():
        raise UsageError(f"{out_dir} cannot be made: {ancestor} is not a folder")
    if not os.access(ancestor, os.W_OK | os.X_OK):
        raise UsageError(f"{out_dir} cannot be made: {ancestor} is not writable")


def _taken(out_dir: Path) -> UsageError:
    what = "choose another folder or add --force (in an order force)"
    return UsageError(f"{out_dir} exists; {what}")


def _check_existing(out_dir: Path, inputs: tuple[Path, ...]) -> None:
    """Refuse what stays whether ``force`` is given or not, so that no one is told to give it."""
    if not out_dir.is_dir():
        raise UsageError(f"{out_dir} is a file; name a folder")
    # Not of the path as given: "." is its own parent, and so looks like a mount point.
    whole = out_dir.resolve()
    if whole.is_mount():
        raise UsageError(f"{out_dir} is a mount point, which cannot be replaced; name a new folder")
    kept = [(path.resolve(), f"input {path.name}") for path in inputs]
    for where, what in ((Path.cwd, "working folder"), (Path.home, "home folder")):
        # Deleted, or a user without one.
        with contextlib.suppress(OSError, RuntimeError):
            kept.append((where(), what))
    for precious, what in kept:
        if precious == whole:
            raise UsageError(f"{out_dir} is the {what}, which is not replaced; name a new folder")
        if whole in precious.parents:
            raise UsageError(f"{out_dir} holds the {what}, which is not deleted; name a new folder")
    other = in_the_way(out_dir)
    if other is not None:
        raise UsageError(
            f"{out_dir} holds {other}, which gcar did not write, and is not replaced, also not "
            "with --force; name another folder"
        )


def manifest_of(folder: Path) -> dict[str, Any] | None:
    """Content of the manifest that this program wrote into a folder; None without one."""
    for name in MANIFESTS:
        try:
            found = json.loads(read_bounded(folder / name, _MOST_BYTES))
        except (ValueError, RecursionError):  # no such file, or no JSON
            continue
        ours = isinstance(found, dict) and str(found.get("schema", "")).startswith("gcar-")
        if ours and isinstance(found.get("files"), dict):
            return dict(found)
    return None


def in_the_way(folder: Path) -> str | None:
    """Name of something in a folder that this program did not write; None where there is none."""
    manifest = manifest_of(folder)
    known = set(LEFT_BY_DESKTOPS)
    if manifest is not None:
        known.update(MANIFESTS, manifest["files"])
    try:
        return min((path.name for path in folder.iterdir() if path.name not in known), default=None)
    except OSError as error:
        raise UsageError(f"{folder} cannot be read ({error.strerror})") from None


def listed(files: Mapping[str, bytes]) -> dict[str, dict[str, Any]]:
    """Size and SHA-256 of each file, as a manifest lists them."""
    return {
        name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        for name, data in files.items()
    }


def write_folder(out_dir: Path, files: Mapping[str, bytes], *, force: bool = False) -> None:
    """Write files into a new folder by way of a temporary one beside it and a rename.

    The files are on the disk before the rename. An existing folder (with ``force``) is
    exchanged in one step where the system can, and removed afterwards; whatever happens, one
    of the two complete folders stands at ``out_dir``. What killed runs left beside it is removed.
    Where the files have no ``result.json``, a ``manifest.json`` with their list is written too.

    Raises
    ------
    UsageError
        As ``check_target``.
    GcarError
        The disk refused.
    """
    check_target(out_dir, force=force)
    if not any(name in files for name in MANIFESTS):
        text = json.dumps({"schema": _SCHEMA, "files": listed(files)}, indent=1) + "\n"
        files = {**files, "manifest.json": text.encode("utf-8")}
    try:
        with _parents(out_dir), scratch_folder(out_dir.absolute().parent) as scratch:
            fresh = scratch / FRESH
            fresh.mkdir()
            # Each file waits for the disk; together they wait once.
            with ThreadPoolExecutor(_WRITERS, "gcar-write") as pool:
                list(pool.map(lambda name: _write(fresh / name, files[name]), files))
            _sync_folder(fresh)
            _put(fresh, out_dir, scratch / OLD, force=force)
            _sync_folder(out_dir.absolute().parent)
        sweep(out_dir.absolute().parent)
    except OSError as error:
        raise GcarError(f"{out_dir} cannot be written ({error.strerror or error})") from None


@contextlib.contextmanager
def _parents(out_dir: Path) -> Iterator[None]:
    """Make missing parents; take those away again if the body fails."""
    missing: list[Path] = []
    parent = out_dir.absolute().parent
    while not parent.exists():
        missing.append(parent)
        parent = parent.parent
    try:
        for folder in reversed(missing):
            folder.mkdir(exist_ok=True)
        yield
    except BaseException:
        # An interrupt as well must leave nothing; another process's files stay.
        for folder in missing:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


def _write(path: Path, data: bytes) -> None:
    with open(path, "xb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


def _sync_folder(path: Path) -> None:
    if os.name != "posix":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _put(fresh: Path, out_dir: Path, old: Path, *, force: bool) -> None:
    if not out_dir.exists():
        try:
            if not _rename2(fresh, out_dir, _RENAME_NOREPLACE):
                os.rename(fresh, out_dir)
            return
        except OSError as error:
            # Another run may have been faster.
            if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                raise
    _check_existing(out_dir, ())
    if not force:
        raise _taken(out_dir)
    if _rename2(fresh, out_dir, _RENAME_EXCHANGE):
        return
    os.rename(out_dir, old)
    try:
        os.rename(fresh, out_dir)
    except BaseException:
        os.rename(old, out_dir)
        raise


def _rename2(source: Path, target: Path, flag: int) -> bool:
    """Linux renameat2; False where the system or file system has no such call."""
    if not sys.platform.startswith("linux"):
        return False
    try:
        call = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return False
    done = call(_AT_FDCWD, os.fsencode(source), _AT_FDCWD, os.fsencode(target), flag)
    if done == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.EPERM):
        return False
    raise OSError(code, os.strerror(code), str(target))
