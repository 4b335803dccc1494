"""Which files of a folder are label volumes: one rule for every verb that takes such a folder."""

from __future__ import annotations

from pathlib import Path

import click

from gcar_deploy.errors import UsageError
from gcar_export.scenes.labels import case_stem

#: ends of the names of label volumes, in small or capital letters
SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd")
#: a bare array, which says nothing of its place: ASOCA Normal_1 as released with 3DGR-CAR
ARRAY = ".npz"
#: folders within the one that is given that are looked into, in this order, before it
FOLDERS = ("imagecas", "asoca")
#: so many files that are left out are named one by one
MOST_NAMED = 5


def label_files(data: Path, *, arrays: bool = False) -> list[Path]:
    """Label volumes in a folder, in its ``imagecas/`` and ``asoca/``, or else in its ``data/``.

    What looks like a volume and is left out is named on stderr: pictures beside their labels
    (``1.img.nii.gz`` or ``1.nii.gz`` beside ``1.label.nii.gz``), and other folders.

    Parameters
    ----------
    data : folder
    arrays : also ``asoca/*.npz``, whose voxels of 1.4 mm are too coarse to measure a lumen on

    Raises
    ------
    UsageError
        There are none.
    """
    left_out: list[str] = []
    for folder in (data, data / "data"):
        found, passed = _within(folder, arrays=arrays)
        left_out += passed
        if found:
            break
    else:
        ends = ", ".join(SUFFIXES)
        beside = f"; left out: {_named(left_out)}" if left_out else ""
        raise UsageError(f"no label volume in {data} ({ends}; also in imagecas/, asoca/){beside}")
    if left_out:
        click.echo(f"{data}: {len(found)} label volumes; left out: {_named(left_out)}", err=True)
    return found


def _within(folder: Path, *, arrays: bool) -> tuple[list[Path], list[str]]:
    """Label volumes by the rule, and what is left out, by name."""
    if not folder.is_dir():
        return [], []
    inside = sorted(path for path in folder.iterdir() if path.is_dir())
    known = [path for name in FOLDERS for path in inside if path.name.lower() == name]
    found: dict[Path, None] = {}
    left_out = []
    for place in (*known, folder):
        asoca = place.name.lower() == "asoca"
        files = sorted(path for path in place.iterdir() if path.is_file())
        labelled = {case_stem(path) for path in files if ".label." in path.name.lower()}
        for path in files:
            array = asoca and path.name.lower().endswith(ARRAY)
            if not (array or _is_volume(path)):
                continue
            stem, label = case_stem(path), ".label." in path.name.lower()
            picture = not label and stem.removesuffix(".img") in labelled
            if picture or (array and not arrays):
                left_out.append(str(path.relative_to(folder)))
            else:
                found.setdefault(path.resolve())
    for place in inside:
        if place not in known and place.name != "data":
            count = sum(_is_volume(path) for path in place.iterdir())
            left_out += [f"{place.name}/ ({count} files)"] if count else []
    return list(found), left_out


def _is_volume(path: Path) -> bool:
    return path.is_file() and path.name.lower().endswith(SUFFIXES)


def _named(names: list[str]) -> str:
    more = len(names) - MOST_NAMED
    return ", ".join(names[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
