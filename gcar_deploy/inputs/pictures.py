"""Pair pictures, files or in memory, with the geometry they were taken by."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from gcar_deploy.config import DicomOptions, ImagingOptions, PictureLimits, RunOptions
from gcar_deploy.dicom.header import is_dicom
from gcar_deploy.dicom.scene import as_angiogram, check_origin, read_run, read_views
from gcar_deploy.errors import GeometryError, ImageError, UsageError
from gcar_deploy.files import is_folder, path_of
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Scene, View, load_scene, match_picture, parse_scene
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.imaging.extract import above_half
from gcar_deploy.imaging.full_mask import MOST_VESSEL
from gcar_deploy.imaging.read import check_opens, from_zero, read_picture
from gcar_deploy.inputs.drawn import Drawn
from gcar_deploy.inputs.runs import find_runs, seen_runs, together, with_bare

#: a file, an array of counts, or a picture that already knows its C-arm
Picture: TypeAlias = "str | Path | np.ndarray | Angiogram"
#: geom.json as a file, its content, a Scene; or only a Grid where every picture is an Angiogram
Geometry: TypeAlias = "str | Path | Mapping[str, Any] | Scene | Grid"
#: a vessel mask: vessel is what exceeds half of its largest value
Mask: TypeAlias = "str | Path | np.ndarray"
_DEPTHS = {"uint8": 8, "uint16": 16, "float32": 32, "float64": 64}


def prepare(
    views: Sequence[Picture],
    geometry: Geometry | None,
    options: RunOptions,
    masks: Mapping[int, Mask] | None = None,
    drawn: Mapping[int, Drawn] | None = None,
    check: Callable[[], None] | None = None,
) -> tuple[list[Angiogram], Grid, list[str]]:
    """Pair pictures with their views.

    Parameters
    ----------
    views : 2 or more pictures, in the order of the geometry's views
    geometry : where they were taken from; None where DICOM headers say it
    options : RunOptions, of which ``dicom`` and ``imaging`` are used
    masks : number of the view, from 1 -> vessel mask (picture of its size)
    drawn : number of the view -> strokes and region of interest
    check : called before each frame of a run is read; what it raises ends the reading

    Returns
    -------
    angiograms, grid asked for, sentences worth telling

    Raises
    ------
    UsageError
        Fewer than two pictures, a mask or strokes of no view, or strokes of another picture.
    GeometryError
        Not as many pictures as views, or sizes at odds (see ``match_picture``).
    ImageError
        A picture or mask cannot be read.
    """
    _check_kinds(views)
    masks = {} if masks is None else masks
    _check_masks(masks)
    if geometry is None:
        angiograms, grid, notes = _from_headers(views, options, check)
    elif isinstance(geometry, Grid):
        angiograms, grid, notes = _in_memory(views), geometry, []
    else:
        scene = _scene(geometry)
        if len(scene.views) != len(views):
            file = f"{Path(geometry).name}: " if isinstance(geometry, (str, Path)) else ""
            raise GeometryError(
                f"{file}{len(views)} pictures are given, but the geometry has "
                f"{len(scene.views)} views"
            )
        angiograms, grid, notes = _by_scene(views, scene, options, check)
    angiograms = [
        dataclasses.replace(one, file=Path(view).name) if isinstance(view, (str, Path)) else one
        for one, view in zip(angiograms, views, strict=True)
    ]
    angiograms = [one.in_range() for one in angiograms]
    angiograms = with_masks(angiograms, masks, options.imaging.limits)
    notes += [f"view {k}: the vessel mask is the user's" for k in masks]
    for k, lines in (drawn or {}).items():
        place = _index(k, "edits", angiograms)
        angiograms[place] = with_drawn(angiograms[place], lines)
        notes += [f"view {k}: {text}" for text in _said(lines, angiograms[place].pixels.shape)]
    return angiograms, grid, notes


def _check_kinds(views: Sequence[Picture]) -> None:
    """Say at once what is no list of pictures: a string is a sequence as well."""
    if isinstance(views, (str, bytes)) or not isinstance(views, (Sequence, np.ndarray)):
        raise UsageError(f"views is a {type(views).__name__}; give a list of two or more pictures")
    if isinstance(views, np.ndarray) and views.ndim == 0:
        raise UsageError("views is one number; give a list of two or more pictures")
    if len(views) < 2:
        raise UsageError(f"{len(views)} picture given; two or more are needed")
    for number, view in enumerate(views, start=1):
        if not isinstance(view, (str, Path, np.ndarray, Angiogram)):
            raise UsageError(
                f"view {number} is a {type(view).__name__}; give a path, an array of counts or an "
                "Angiogram"
            )
        if isinstance(view, str):
            path_of(view, f"view {number}", ImageError)


def _check_masks(masks: Mapping[int, Mask]) -> None:
    how = "give a dict: number of the view, from 1 -> path or array"
    if not isinstance(masks, Mapping):
        raise UsageError(f"masks is a {type(masks).__name__}; {how}")
    for number, mask in masks.items():
        if not isinstance(number, (int, np.integer)):
            raise UsageError(f"masks has a {type(number).__name__} as a key; {how}")
        if not isinstance(mask, (str, Path, np.ndarray)):
            raise UsageError(f"mask {number} is a {type(mask).__name__}; {how}")
        if isinstance(mask, str):
            path_of(mask, f"mask {number}", ImageError)


def with_drawn(angiogram: Angiogram, drawn: Drawn) -> Angiogram:
    """Give a picture what was drawn in it.

    Raises
    ------
    UsageError
        It was drawn on another picture.
    """
    if drawn.on not in ("", angiogram.sha256):
        raise UsageError(
            f"view {angiogram.view_id}: what is drawn or marked was so on another picture (SHA-256 "
            f"{drawn.on[:12]}, not {angiogram.sha256[:12]}); take drawn_on out of the order to use "
            "it all the same"
        )
    shape = angiogram.pixels.shape
    marks, inside = drawn.marks(shape), drawn.inside(shape)
    if marks is not None:
        angiogram = dataclasses.replace(angiogram, erased=marks[0], painted=marks[1])
    if inside is not None:
        valid = inside if angiogram.valid is None else inside & angiogram.valid
        angiogram = dataclasses.replace(angiogram, valid=valid)
    return angiogram


def _said(drawn: Drawn, shape: tuple[int, ...]) -> list[str]:
    seen = [one for one in drawn.strokes if one.meets(shape)]
    count = {do: sum(one.do == do for one in seen) for do in ("erase", "paint")}
    out = [
        f"{n} strokes of the user {do} vessel" if n > 1 else f"1 stroke of the user {do}s vessel"
        for do, n in count.items() if n
    ]  # fmt: skip
    if missed := len(drawn.strokes) - len(seen):
        out.append(f"of the user's strokes, {missed} outside the picture: without effect")
    return out + (["only the user's region of interest is looked at"] if drawn.region else [])


def _index(number: int, what: str, angiograms: Sequence[Angiogram]) -> int:
    if not 1 <= number <= len(angiograms):
        raise UsageError(f"{what} {number}: there are views 1 .. {len(angiograms)}")
    return number - 1


def with_masks(
    angiograms: Sequence[Angiogram],
    masks: Mapping[int, Mask],
    limits: PictureLimits,
) -> list[Angiogram]:
    """Give pictures the user's vessel masks.

    Raises
    ------
    UsageError
        There is no view of that number.
    ImageError
        A mask cannot be read, has another size than its picture, or no vessel.
    """
    out = list(angiograms)
    for number, given in masks.items():
        place = _index(number, "mask", out)
        if isinstance(given, np.ndarray):
            array = _unmasked(f"mask {number}", given)
            if array.dtype.kind not in "biuf":
                raise ImageError(f"mask {number} holds {array.dtype}; give numbers or booleans")
            sha256 = _digest(array)
        else:
            array, _, sha256 = read_picture(given, limits, binary=True)
        shape = out[place].pixels.shape
        if array.shape != shape:
            raise ImageError(
                f"mask {number} has {array.shape} (rows, columns), its picture {shape}"
            )
        mask = above_half(array)
        if not mask.any() or mask.mean() > MOST_VESSEL:
            raise ImageError(
                f"mask {number} marks {mask.mean():.0%} of the picture as vessel "
                f"(at most {MOST_VESSEL:.0%} can be)"
            )
        out[place] = dataclasses.replace(out[place], mask=mask, mask_sha256=sha256)
    return out


def _in_memory(views: Sequence[Picture]) -> list[Angiogram]:
    """Pictures that know their C-arms."""
    given = [view for view in views if isinstance(view, Angiogram)]
    if len(given) != len(views):
        raise UsageError("a Grid alone tells no geometry: give a scene, or Angiograms")
    return given


def _by_scene(
    views: Sequence[Picture],
    scene: Scene,
    options: RunOptions,
    check: Callable[[], None] | None,
) -> tuple[list[Angiogram], Grid, list[str]]:
    """Pictures of any kind, each with the view of its place."""
    angiograms, headers = [], {}
    runs = find_runs(views, options, scene, check)
    notes = [*scene.warnings, *_unused(options.dicom, any_run=bool(runs.wanted))]
    seen = seen_runs(runs, scene, options)
    chosen = together(runs, seen)
    for number, (picture, view) in enumerate(zip(views, scene.views, strict=True), start=1):
        if isinstance(picture, Angiogram):
            angiograms.append(picture)
        elif isinstance(picture, (str, Path)) and is_dicom(picture):
            frame = chosen.get(number, runs.wanted[number])
            run = read_run(picture, options.dicom, frame, check)
            carm = _matched(view, run.pixels.shape, options.imaging, notes, picture)
            angiograms.append(as_angiogram(run, dataclasses.replace(view, carm=carm)))
            headers[number] = run.header
            notes += [f"view {view.id}: {note}" for note in run.notes]
        elif number in runs.cines:
            *read, frame = runs.frame(number, chosen, view.intensity)
            made = _as_angiogram(read, view, options.imaging, notes, picture)
            angiograms.append(dataclasses.replace(made, frame=frame))
            if frame is not None:
                notes.append(f"view {view.id}: frame {frame.number} of {frame.of}: {frame.reason}")
        else:
            angiograms.append(_angiogram(picture, view, options.imaging, notes))
    notes += check_origin(headers)
    angiograms, more = with_bare(angiograms, runs, seen)
    return angiograms, scene.volume_grid(), notes + more


def _unused(options: DicomOptions, *, any_run: bool) -> list[str]:
    """Say which options have nothing to act on, where a scene tells the geometry."""
    said = []
    if options.frames != DicomOptions().frames and not any_run:
        said.append("the frame asked for (frames) is not used: no view is a run")
    for key in ("pixel_spacing_mm", "sod_mm"):
        if getattr(options, key) is not None:
            said.append(f"{key} as an option is not used: the geometry has its own")
    return said


def _angiogram(
    picture: str | Path | np.ndarray, view: View, options: ImagingOptions, notes: list[str]
) -> Angiogram:
    """Read a picture file, or take an array; what was rescaled is added to ``notes``."""
    if isinstance(picture, np.ndarray):
        read = _from_array(view, picture, options.limits)
    else:
        kind = view.intensity
        read = read_picture(
            picture, options.limits, subtracted=kind.subtracted, binary=kind.kind == "mask"
        )
    return _as_angiogram(read, view, options, notes, picture)


def _as_angiogram(
    read: Sequence[Any], view: View, options: ImagingOptions, notes: list[str], source: object
) -> Angiogram:
    """Pair pixels, bit depth and SHA-256 with their view; ``source`` is where they are from."""
    pixels, depth, sha256 = read
    return Angiogram(
        view_id=view.id, carm=_matched(view, pixels.shape, options, notes, source), pixels=pixels,
        bit_depth=depth, intensity=view.intensity, sha256=sha256,
        enlarged=pixels.shape[0] / view.carm.rows,
    )  # fmt: skip


def _from_headers(
    views: Sequence[Picture], options: RunOptions, check: Callable[[], None] | None
) -> tuple[list[Angiogram], Grid, list[str]]:
    """Pictures whose own headers tell the geometry: DICOM XA alone."""
    paths = [view for view in views if isinstance(view, (str, Path))]
    for path in paths:
        if is_folder(path):
            raise UsageError(
                f"{Path(path).name} is a folder: name the DICOM file of the run in it, or tell the "
                "geometry of its pictures (--geom geom.json)"
            )
        if not is_dicom(path):
            check_opens(path)
            raise UsageError(
                f"{Path(path).name} is no DICOM file: its geometry is needed (--geom geom.json)"
            )
    if len(paths) != len(views):
        raise UsageError("pictures in memory tell no geometry: give a scene")
    runs = find_runs(paths, options, check=check)
    seen = seen_runs(runs, None, options)
    angiograms, scene, notes = read_views(paths, options.dicom, together(runs, seen), check)
    angiograms, more = with_bare(angiograms, runs, seen)
    return angiograms, scene.volume_grid(), notes + more


def _matched(
    view: View, shape: tuple[int, ...], options: ImagingOptions, notes: list[str], source: object
) -> CArm:
    """Fit a view to the size of its picture; what was rescaled is added to ``notes``."""
    try:
        carm, note = match_picture(
            view.carm, shape[0], shape[1], allow_rescale=options.allow_rescale
        )
    except GeometryError as error:
        file = f"{Path(source).name}, " if isinstance(source, (str, Path)) else ""
        raise GeometryError(f"{file}view {view.id}: {error}") from None
    if note:
        notes.append(f"view {view.id}: {note}")
    return carm


def _from_array(
    view: View, array: np.ndarray, limits: PictureLimits
) -> tuple[np.ndarray, int, str]:
    """Like ``read_picture`` for counts that are in memory already."""
    view_id = view.id
    array = _unmasked(f"view {view_id}", array)
    if array.dtype == bool and view.intensity.kind == "mask":
        array = array.astype(np.uint8)
    depth = _DEPTHS.get(array.dtype.name)
    if depth is None or array.ndim != 2:
        raise ImageError(
            f"view {view_id}: an array of {array.dtype} with {array.ndim} dimensions; give "
            "(rows, columns) of uint8, uint16, float32 or float64"
        )
    if not limits.min_side <= min(array.shape) <= max(array.shape) <= limits.max_side:
        raise ImageError(
            f"view {view_id}: {array.shape[0]} x {array.shape[1]} pixels; each side must be "
            f"{limits.min_side} .. {limits.max_side}"
        )
    given, array = array, from_zero(array) if view.intensity.subtracted else array
    with np.errstate(over="ignore"):
        # Columns first in memory is the same picture: what follows looks at rows.
        pixels = array.astype(np.float32, order="C")
    if not (np.isfinite(pixels).all() and pixels.min() >= 0):
        raise ImageError(
            f"view {view_id}: grey values must be finite in single precision and not negative"
        )
    return pixels, depth, _digest(given)


def _digest(array: np.ndarray) -> str:
    """SHA-256 of an array's numbers, type and shape."""
    sha256 = hashlib.sha256(f"{array.dtype.name}{array.shape}".encode())
    sha256.update(np.ascontiguousarray(array).tobytes())
    return sha256.hexdigest()


def _unmasked(name: str, array: np.ndarray) -> np.ndarray:
    """Return a plain array; what numpy's masked pixels hold is nobody's grey value."""
    count = int(np.ma.count_masked(array)) if isinstance(array, np.ma.MaskedArray) else 0
    if count:
        raise ImageError(
            f"{name}: {count} pixels of the array are masked; fill them (numpy.ma.filled), or give "
            "an Angiogram whose valid leaves them out"
        )
    return np.asarray(array)


def _of_numpy(value: object) -> Any:
    """Say what numpy's numbers and arrays are in JSON."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise TypeError(f"a {type(value).__name__} is no JSON value")


def _scene(geometry: Geometry) -> Scene:
    if isinstance(geometry, Scene):
        return geometry
    if isinstance(geometry, Mapping):
        try:
            return parse_scene(json.dumps(dict(geometry), default=_of_numpy), "geometry")
        except (TypeError, ValueError, RecursionError) as error:
            raise GeometryError(f"geometry cannot be written as JSON: {error}") from None
    if isinstance(geometry, str) and geometry.lstrip().startswith("{"):
        raise UsageError("geometry is JSON text; give a path, or json.loads of it")
    if isinstance(geometry, (str, Path)):
        return load_scene(path_of(geometry, "geometry", GeometryError))
    raise UsageError(f"geometry is a {type(geometry).__name__}; give a path, dict or Scene")
