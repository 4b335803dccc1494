"""The scene file ``geom.json`` (schema gcar-geometry/1) to views and back.

Parsing is strict: 64 KiB of UTF-8 (or UTF-16 behind its byte order mark), no NaN or Infinity, no
duplicate or unknown keys, no booleans for numbers. Every refusal is one line that names the file,
the view, the key and the value.
"""

from __future__ import annotations

import dataclasses
import json
from numbers import Real
from pathlib import Path
from typing import Any

from gcar_deploy.errors import GeometryError
from gcar_deploy.files import read_text
from gcar_deploy.geometry.carm import CLINICAL_RANGES, CArm
from gcar_deploy.geometry.default_grid import default_grid
from gcar_deploy.geometry.fields import (
    LEAST_VIEWS,
    MAX_BYTES,
    MOST_VIEWS,
    check_choice,
    check_object,
    number,
    numbers,
    quote,
    read_json,
    whole,
)
from gcar_deploy.geometry.grid import Grid

SCHEMA = "gcar-geometry/1"
KINDS = ("path_length", "attenuation", "raw", "mask")
POLARITIES = ("auto", "dark", "bright")
#: bounds that keep the arithmetic finite: table positions, principal points, matrix entries
MAX_OFFSET_MM, MAX_POINT_PX, MAX_ENTRY = 500.0, 1e5, 1e9

_VIEW_NUMBERS = ("primary_angle_deg", "secondary_angle_deg", "sod_mm", "sdd_mm")
_REQUIRED = (*_VIEW_NUMBERS, "rows", "columns", "pixel_spacing_mm")
_OPTIONAL = (
    "id",
    "detector_rotation_deg",
    "principal_point_px",
    "isocenter_offset_mm",
    "projection_matrix",
    "intensity",
)
_ROTATION = "detector_rotation_deg"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Intensity:
    """What a count of the picture means.

    Attributes
    ----------
    kind : ``path_length``, ``attenuation``, ``raw`` or ``mask``
    polarity : ``auto``, ``dark`` or ``bright`` (how vessels look)
    mm_per_count : float or None
        mm of vessel along the ray per count; needed for ``path_length`` alone.

    Raises
    ------
    GeometryError
        A value is none of these, or ``mm_per_count`` outside 1e-9 .. 1000 mm.
    """

    kind: str
    polarity: str = "auto"
    mm_per_count: float | None = None

    def __post_init__(self) -> None:
        check_choice("intensity.kind", self.kind, KINDS)
        check_choice("intensity.polarity", self.polarity, POLARITIES)
        scale = self.mm_per_count
        if scale is not None:
            _check_scale(scale)
        if self.kind == "path_length" and scale is None:
            raise GeometryError("intensity.mm_per_count is missing: kind path_length needs it")

    @property
    def subtracted(self) -> bool:
        """Whether the picture is what vessels add to another, whose noise lies about 0."""
        return self.kind in ("path_length", "attenuation")


def _check_scale(scale: Any) -> None:
    named = f"intensity.mm_per_count = {quote(scale)}"
    if isinstance(scale, bool) or not isinstance(scale, Real):
        raise GeometryError(f"{named} must be a number of 1e-9 .. 1000 mm")
    if not 1e-9 <= float(scale) <= 1e3:
        raise GeometryError(f"{named} is outside 1e-9 .. 1000 mm")


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """One view of the scene: a name, its geometry, what its pixels mean."""

    id: str
    carm: CArm
    intensity: Intensity


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scene:
    """All views of one patient at one moment, and the volume that is asked for.

    Attributes
    ----------
    views : 2 .. 16 View
    grid : Grid or None, the ``volume`` of the file
    warnings : sentences about values that are allowed but unusual
    """

    views: tuple[View, ...]
    grid: Grid | None = None
    warnings: tuple[str, ...] = ()

    def volume_grid(self) -> Grid:
        """Return the grid asked for, or a cube that all views cover (``default_grid``)."""
        return self.grid if self.grid is not None else default_grid([v.carm for v in self.views])


def load_scene(path: str | Path) -> Scene:
    """Read and check a scene file.

    Raises
    ------
    GeometryError
        The file is missing, too large, not UTF-8 JSON, or holds a wrong value.
    """
    path = Path(path)
    try:
        text = read_text(path, MAX_BYTES)
    except ValueError as error:
        raise GeometryError(f"{path.name} cannot be read: {error}") from None
    return parse_scene(text, path.name)


def parse_scene(text: str, name: str = "geom.json") -> Scene:
    """Check the text of a scene file; ``name`` is what errors call it."""
    try:
        return _scene(read_json(text))
    except GeometryError as error:
        raise GeometryError(f"{name}: {error}") from None


def scene_to_json(scene: Scene) -> str:
    """Return the scene as the text of a ``geom.json`` that parses to the same scene."""
    views = [
        {"id": view.id, **_values(view.carm), "intensity": dataclasses.asdict(view.intensity)}
        for view in scene.views
    ]
    data: dict[str, Any] = {"schema": SCHEMA, "frame": "LPS", "views": views}
    if scene.grid is not None:
        g = scene.grid
        data["volume"] = {
            "center_mm": list(g.center_mm),
            "size_mm": list(g.size_mm),
            "shape": list(g.shape),
        }
    return json.dumps(data, indent=1) + "\n"


def told_view(carm: CArm, intensity: Intensity) -> dict[str, Any]:
    """Return a view as ``geom.json`` tells it but for its id, without what is left open."""
    view, meaning = (
        {key: value for key, value in all_of_it.items() if value is not None}
        for all_of_it in (_values(carm), dataclasses.asdict(intensity))
    )
    return {**view, "intensity": meaning}


def _values(carm: CArm) -> dict[str, Any]:
    point, matrix = carm.principal_point_px, carm.projection_matrix
    return {
        **{key: getattr(carm, key) for key in _VIEW_NUMBERS},
        "detector_rotation_deg": carm.detector_rotation_deg,
        "rows": carm.rows,
        "columns": carm.columns,
        "pixel_spacing_mm": list(carm.pixel_spacing_mm),
        "principal_point_px": None if point is None else list(point),
        "isocenter_offset_mm": list(carm.isocenter_offset_mm),
        "projection_matrix": None if matrix is None else [list(row) for row in matrix],
    }


def match_picture(
    carm: CArm, rows: int, columns: int, *, allow_rescale: bool
) -> tuple[CArm, str | None]:
    """Fit a view to the size of its picture.

    Parameters
    ----------
    carm : CArm
    rows, columns : of the picture
    allow_rescale : whether any other size of the same shape may be a rescaled picture; it may as
        well be a crop, which nobody can tell from it. Whole multiples and parts need no leave

    Returns
    -------
    carm : CArm of the picture's own size
    sentence : None where the sizes agree, else what was rescaled

    Raises
    ------
    GeometryError
        The picture has another size and rescaling is not allowed, or is no exact one.
    """
    if (rows, columns) == (carm.rows, carm.columns):
        return carm, None
    if rows * carm.columns != columns * carm.rows:
        raise GeometryError(
            f"rows x columns = {carm.rows} x {carm.columns} is at odds with the picture's "
            f"{rows} x {columns}, which is no exact rescaling"
        )
    whole = max(rows, carm.rows) % min(rows, carm.rows) == 0
    if not whole and not allow_rescale:
        raise GeometryError(
            f"rows x columns = {carm.rows} x {carm.columns} is at odds with the picture's "
            f"{rows} x {columns}; allow_rescale (--allow-rescale) takes it for the whole picture "
            "rescaled, which a crop is not"
        )
    scale = rows / carm.rows
    return carm.resized(rows, columns), (
        f"the picture is {rows} x {columns}, {scale:g} times the {carm.rows} x {carm.columns} of "
        "the geometry; the pixel spacing was scaled with it"
    )


# -- parsing --------------------------------------------------------------------------------


def _scene(data: Any) -> Scene:
    check_object("the file", data, ("schema", "frame", "views", "volume"))
    if data.get("schema") != SCHEMA:
        raise GeometryError(f"schema = {quote(data.get('schema'))} must be {SCHEMA!r}")
    if data.get("frame", "LPS") != "LPS":
        raise GeometryError(f"frame = {quote(data['frame'])} must be 'LPS'")
    views = data.get("views")
    if not isinstance(views, list):
        raise GeometryError("views is missing or not a list")
    if not LEAST_VIEWS <= len(views) <= MOST_VIEWS:
        raise GeometryError(
            f"views holds {len(views)} entries, {LEAST_VIEWS} .. {MOST_VIEWS} are needed"
        )
    parsed: list[View] = []
    for k, entry in enumerate(views):
        try:
            parsed.append(_view(entry, k))
        except GeometryError as error:
            raise GeometryError(f"view {k + 1}: {error}") from None
        if parsed[-1].id in [v.id for v in parsed[:-1]]:
            raise GeometryError(f"view {k + 1}: id {parsed[-1].id!r} stands twice")
    volume = data.get("volume")
    grid = None if volume is None else _grid(volume)
    scene = Scene(views=tuple(parsed), grid=grid, warnings=tuple(_warnings(parsed, views)))
    _check_placing(scene)
    return scene


def _view(entry: Any, k: int) -> View:
    check_object("the view", entry, (*_REQUIRED, *_OPTIONAL))
    name = entry.get("id", str(k + 1))
    if not isinstance(name, str) or not 1 <= len(name) <= 64 or not name.isprintable():
        raise GeometryError(f"id = {quote(name)} must be text of 1 .. 64 characters")
    alone = _matrix_alone(entry)
    for key in ("rows", "columns") if alone else _REQUIRED:
        if entry.get(key) is None:
            raise GeometryError(f"{key} is missing")
    carm = _carm_of_matrix(entry) if alone else _carm_of_angles(entry)
    return View(id=name, carm=carm, intensity=_intensity(entry.get("intensity")))


def _matrix_alone(entry: dict[str, Any]) -> bool:
    """Tell whether a matrix replaces the angles and distances, rather than stand beside them."""
    return entry.get("projection_matrix") is not None and not any(
        key in entry for key in _VIEW_NUMBERS
    )


def _carm_of_angles(entry: dict[str, Any]) -> CArm:
    spacing = numbers("pixel_spacing_mm", entry["pixel_spacing_mm"], 2)
    point = entry.get("principal_point_px")
    if point is not None:
        point = tuple(numbers("principal_point_px", point, 2, MAX_POINT_PX))
    offset = entry.get("isocenter_offset_mm")
    if offset is None:
        offset = [0.0, 0.0, 0.0]
    moved = numbers("isocenter_offset_mm", offset, 3, MAX_OFFSET_MM)
    rotation = entry.get("detector_rotation_deg")
    return CArm(
        **{key: number(key, entry[key]) for key in _VIEW_NUMBERS},
        rows=whole("rows", entry["rows"]),
        columns=whole("columns", entry["columns"]),
        pixel_spacing_mm=(spacing[0], spacing[1]),
        detector_rotation_deg=0.0 if rotation is None else number(_ROTATION, rotation),
        principal_point_px=point,
        isocenter_offset_mm=(moved[0], moved[1], moved[2]),
        projection_matrix=_matrix(entry.get("projection_matrix")),
    )


def _carm_of_matrix(entry: dict[str, Any]) -> CArm:
    """Build the view from its matrix; the pixel spacing, if given, tells the detector's distance.

    A matrix holds rotation, principal point and table position already: a second word on them
    would have to be ignored, so it is refused.
    """
    for key in (_ROTATION, "principal_point_px", "isocenter_offset_mm"):
        value = entry.get(key)
        if value not in (None, 0, [0, 0, 0]) or isinstance(value, bool):
            raise GeometryError(f"{key} = {quote(value)} is at odds with a lone projection_matrix")
    rows, columns = whole("rows", entry["rows"]), whole("columns", entry["columns"])
    matrix = _matrix(entry["projection_matrix"])
    carm = CArm.from_matrix(matrix, rows=rows, columns=columns)
    if entry.get("pixel_spacing_mm") is None:
        return carm
    row, column = numbers("pixel_spacing_mm", entry["pixel_spacing_mm"], 2)
    return dataclasses.replace(carm, pixel_spacing_mm=(row, column), sdd_mm=carm.focal_px[1] * row)


def _matrix(matrix: Any) -> tuple[tuple[float, ...], ...] | None:
    if matrix is None:
        return None
    if not isinstance(matrix, list) or len(matrix) != 3:
        raise GeometryError("projection_matrix must be 3 rows of 4 numbers")
    return tuple(tuple(numbers("projection_matrix row", row, 4, MAX_ENTRY)) for row in matrix)


def _intensity(entry: Any) -> Intensity:
    if entry is None:
        return Intensity(kind="raw")
    check_object("intensity", entry, ("kind", "polarity", "mm_per_count"))
    scale = entry.get("mm_per_count")
    return Intensity(
        kind=entry.get("kind", "raw"),
        polarity=entry.get("polarity", "auto"),
        mm_per_count=None if scale is None else number("intensity.mm_per_count", scale),
    )


def _grid(entry: Any) -> Grid:
    check_object("volume", entry, ("center_mm", "size_mm", "shape"))
    for key in ("size_mm", "shape"):
        if entry.get(key) is None:
            raise GeometryError(f"volume.{key} is missing")
    center = numbers("volume.center_mm", entry.get("center_mm", [0, 0, 0]), 3)
    size = numbers("volume.size_mm", entry["size_mm"], 3)
    shape = entry["shape"]
    if not isinstance(shape, list) or len(shape) != 3:
        raise GeometryError(f"volume.shape = {quote(shape)} must be 3 whole numbers")
    nx, ny, nz = (whole("volume.shape", n) for n in shape)
    return Grid(
        center_mm=(center[0], center[1], center[2]),
        size_mm=(size[0], size[1], size[2]),
        shape=(nx, ny, nz),
    )


def _check_placing(scene: Scene) -> None:
    """Refuse a volume that is not between source and detector: projections mean nothing there."""
    grid = scene.volume_grid()
    corners = grid.corners_mm()
    for view in scene.views:
        depth = view.carm.project(corners)[1]
        if depth.min() < 50.0:
            raise GeometryError(
                f"view {view.id}: volume reaches to {depth.min():.0f} mm from the source; "
                "50 mm at least are needed (sod_mm too small or volume.size_mm too large)"
            )
        # The default volume may reach behind it: whoever named no volume named none too large.
        near = view.carm.projection_matrix is None and grid.bounds
        if near and depth.max() > view.carm.sdd_mm:
            raise GeometryError(
                f"view {view.id}: volume reaches {depth.max() - view.carm.sdd_mm:.0f} mm behind "
                "the detector (sdd_mm too small or volume.size_mm too large)"
            )


def _warnings(views: list[View], entries: list[dict[str, Any]]) -> list[str]:
    out = []
    for view, entry in zip(views, entries, strict=True):
        ranges = dict(CLINICAL_RANGES)
        if _matrix_alone(entry) and entry.get("pixel_spacing_mm") is None:
            del ranges["sdd_mm"]
            out.append(
                f"view {view.id}: a projection_matrix without pixel_spacing_mm does not tell how "
                f"far the detector is; a magnification of {view.carm.magnification:g} is assumed"
            )
        for key, (low, high, unit) in ranges.items():
            value = getattr(view.carm, key)
            if not low <= value <= high:
                out.append(
                    f"view {view.id}: {key} = {value:g} {unit} is outside the usual "
                    f"{low:g} .. {high:g} {unit}"
                )
    return out
