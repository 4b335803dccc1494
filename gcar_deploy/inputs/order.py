"""Order: one reconstruction asked for, the same for command, table of cases and worker.

As JSON it is schema ``gcar-order/1``. Nothing heavy is imported, so that help stays quick.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gcar_deploy.config import (
    PREDICTORS,
    REFINERS,
    SEGMENTERS,
    DicomOptions,
    Landmark,
    LesionBorders,
    RunOptions,
)
from gcar_deploy.config.ranges import Range, check_field, check_number
from gcar_deploy.errors import GeometryError, UsageError
from gcar_deploy.files import digest_of, is_file, read_text
from gcar_deploy.geometry.fields import (
    LEAST_VIEWS,
    MOST_VIEWS,
    check_choice,
    check_object,
    number,
    numbers,
    quote,
    read_json,
    whole,
)
from gcar_deploy.inputs.drawn import (
    Drawn,
    Place,
    Stroke,
    by_view,
    drawn_by_view,
    parse_digests,
    parse_edits,
    parse_point,
    parse_regions,
)

SCHEMA = "gcar-order/1"
#: bytes of an order as JSON: hours of drawing in the pictures may stand in it
MAX_BYTES = 16 * 1024 * 1024
#: a branch to be deleted is named by a place within so much of the isocentre, mm
_FARTHEST_MM = 2000.0
#: no picture or run that is read is larger
_MOST_BYTES = 2**40
POSES = ("auto", "off")
#: further file that an order may ask for -> its name in the result folder
EXTRAS = {"glb": "surface.glb", "dicom-stl": "surface.dcm"}
_CHOICES = {
    "pose": POSES, "segmenter": SEGMENTERS, "predictor": PREDICTORS, "refiner": REFINERS,
}  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class Order:
    """One reconstruction asked for. What is None is as the engine was set up.

    Attributes
    ----------
    views : files of pictures or DICOM runs, in the order of the geometry's views
    geometry : file or content of a ``geom.json``; None where DICOM headers tell it
    masks : number of the view, from 1 -> file of its vessel mask
    landmarks : points marked, (column, row) in each view or None; the last views may be left out
    edits : number of the view, from 1 -> strokes that erase or paint vessel, in their order
    regions : number of the view -> corners of the part that is looked at
    same_branch : a place on one vessel in each view, not the same place of it, or None
    ostia : where arteries begin, points as of ``landmarks``
    deleted_mm : a place on each branch that is to go, mm LPS, in the order of deletion
    lesions : borders of lesions, beside those that are found
    drawn_on : number of the view, from 1 -> SHA-256 of the file that all of these were drawn on;
        they are refused on another
    frames : of each DICOM run, from 1, None to choose; one entry holds for all runs
    pixel_spacing_mm, sod_mm : for DICOM that does not say it, at the detector
    allow_rescale : take a picture of another size than its geometry's for a rescaled one
    pose : ``auto`` or ``off``
    segmenter, predictor, refiner : who finds vessels, who decides depth, how the tree is fitted
    deadline_s : seconds that the work may take
    strict : take a degraded result for a refusal
    force : replace an earlier result folder
    out : result folder
    extras : further files to write, of ``EXTRAS``
    """

    views: tuple[Path, ...] = ()
    geometry: Path | Mapping[str, Any] | None = None
    masks: Mapping[int, Path] = dataclasses.field(default_factory=dict)
    landmarks: tuple[Landmark, ...] | None = None
    edits: Mapping[int, tuple[Stroke, ...]] = dataclasses.field(default_factory=dict)
    regions: Mapping[int, tuple[Place, ...]] = dataclasses.field(default_factory=dict)
    same_branch: tuple[Landmark, ...] | None = None
    ostia: tuple[Landmark, ...] | None = None
    deleted_mm: tuple[tuple[float, float, float], ...] | None = None
    lesions: tuple[LesionBorders, ...] | None = None
    drawn_on: Mapping[int, str] = dataclasses.field(default_factory=dict)
    frames: tuple[int | None, ...] | None = None
    pixel_spacing_mm: float | None = None
    sod_mm: float | None = None
    allow_rescale: bool = False
    pose: str | None = None
    segmenter: str | None = None
    predictor: str | None = None
    refiner: str | None = None
    deadline_s: float | None = None
    strict: bool = False
    force: bool = False
    out: Path | None = None
    extras: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse values out of range, and those that contradict each other.

        Raises
        ------
        UsageError
            One line that names the key and its value.
        """
        for key, choices in _CHOICES.items():
            if getattr(self, key) is not None:
                _as_usage(check_choice, key, getattr(self, key), choices)
        for extra in self.extras:
            _as_usage(check_choice, "extras", extra, tuple(EXTRAS))
        for key in ("frames", "pixel_spacing_mm", "sod_mm"):
            if getattr(self, key) is not None:
                check_field(DicomOptions, key, getattr(self, key))
        if self.deadline_s is not None:
            check_number("deadline_s", self.deadline_s, float, Range(1e-9, 1e9))
        if self.landmarks and self.pose == "off":
            raise UsageError("a landmark corrects the pose: it cannot be used with pose off")

    @property
    def files(self) -> dict[str, Path]:
        """Every file it names: ``view1`` ..., ``geometry``, ``mask1`` ... -> path."""
        found = {f"view{k}": path for k, path in enumerate(self.views, start=1)}
        if isinstance(self.geometry, Path):
            found["geometry"] = self.geometry
        return found | {f"mask{k}": path for k, path in self.masks.items()}

    @property
    def drawn(self) -> dict[int, Drawn]:
        """Number of the view -> what was drawn in it."""
        return drawn_by_view(self.edits, self.regions, self.drawn_on if self._is_drawn else {})

    @property
    def _is_drawn(self) -> bool:
        return any(getattr(self, key) for key in _DRAWN)

    def with_drawn_on(self) -> Order:
        """Return the order with the SHA-256 of its views, where something was drawn on them.

        One that is told already stays; a view that is no file has none.
        """
        if not self._is_drawn:
            return dataclasses.replace(self, drawn_on={})
        new = {
            k: digest_of(path, _MOST_BYTES, 0).hex()
            for k, path in enumerate(self.views, start=1)
            if k not in self.drawn_on and is_file(path)
        }
        return dataclasses.replace(self, drawn_on={**self.drawn_on, **new})

    def with_files(self, change: Callable[[str, Path], Path]) -> Order:
        """Return the order with each of its files replaced by ``change(name, path)``."""
        new = {name: change(name, path) for name, path in self.files.items()}
        return dataclasses.replace(
            self,
            views=tuple(new[f"view{k + 1}"] for k in range(len(self.views))),
            geometry=new.get("geometry", self.geometry),
            masks={k: new[f"mask{k}"] for k in self.masks},
        )

    def relative_to(self, folder: Path) -> Order:
        """Return the order with its relative paths, ``out`` too, taken from ``folder``."""
        order = self.with_files(lambda _, path: folder / path)
        return dataclasses.replace(order, out=None if self.out is None else folder / self.out)

    def options(self, base: RunOptions) -> RunOptions:
        """Return ``base`` with what this order chooses."""
        dicom = _given(self, "frames", "pixel_spacing_mm", "sod_mm")
        pose = {} if self.pose is None else {"enabled": self.pose == "auto"}
        points = _given(self, "landmarks", "same_branch", "ostia")
        marks: dict[str, Any] = {key: self._per_view(own) for key, own in points.items()}
        return dataclasses.replace(
            base,
            dicom=dataclasses.replace(base.dicom, **dicom),
            imaging=dataclasses.replace(
                base.imaging,
                allow_rescale=self.allow_rescale or base.imaging.allow_rescale,
                **_given(self, "segmenter"),
            ),
            pose=dataclasses.replace(base.pose, **pose),
            predict=dataclasses.replace(base.predict, **_given(self, "predictor")),
            refine=dataclasses.replace(base.refine, **_given(self, "refiner")),
            **_given(self, "lesions", "deleted_mm"),
            **marks,
        )

    def _per_view(self, marks: tuple[Landmark, ...]) -> tuple[Landmark, ...]:
        """Points of every view: in those that were added later nothing is marked."""
        count = len(self.views)
        return tuple(
            (*one, *(None,) * (count - len(one))) if len(one) > 1 else one for one in marks
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the order as JSON values; what is at its default is left out."""
        out: dict[str, Any] = {"schema": SCHEMA}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value not in (None, False, (), {}):
                out[field.name] = _plain(value)
        return out


#: keys of what is drawn or marked in the pictures, or holds for the tree of them alone
_DRAWN = ("edits", "regions", "landmarks", "same_branch", "ostia", "deleted_mm", "lesions")
KEYS = ("schema", *(field.name for field in dataclasses.fields(Order)))


def parse_order(values: Any) -> Order:
    """Read an order from JSON values; see ``Order.to_dict``.

    Parameters
    ----------
    values : JSON object; ``schema`` may be left out

    Raises
    ------
    UsageError
        A key is missing, unknown or of the wrong kind, or a value is out of range.
    """
    try:
        return _order(values)
    except GeometryError as error:
        raise UsageError(str(error)) from None


def load_order(path: Path) -> Order:
    """Read an order file; its relative paths begin at its own folder.

    Raises
    ------
    UsageError
        The file cannot be read, or as ``parse_order``.
    """
    try:
        values = read_json(read_text(path, MAX_BYTES), MAX_BYTES)
        return parse_order(values).relative_to(path.parent)
    except (ValueError, GeometryError, UsageError) as error:
        raise UsageError(f"{path.name}: {error}") from None


def order_to_json(order: Order) -> str:
    """Return the order as the text of a file that reads back as the same order: a line a key."""
    lines = (
        f" {json.dumps(k)}: {json.dumps(v, allow_nan=False)}" for k, v in order.to_dict().items()
    )
    return "{\n" + ",\n".join(lines) + "\n}\n"


def check_view_numbers(order: Order) -> None:
    """Refuse an order that has too few or too many views, or a mask without its view.

    Raises
    ------
    UsageError
    """
    count = len(order.views)
    if count < 2:
        raise UsageError(f"{count} picture given; two or more are needed")
    if count > MOST_VIEWS:
        raise UsageError(f"{count} pictures given; at most {MOST_VIEWS} are taken")
    for lesion in order.lesions or ():
        if not 1 <= lesion.view <= count:
            raise UsageError(f"lesions.view = {lesion.view}: there are views 1 .. {count}")
    for what, named in (("mask", order.masks), ("edits", order.edits), ("region", order.regions),
                        ("drawn_on", order.drawn_on)):  # fmt: skip
        for k in named:
            if not 1 <= k <= count:
                raise UsageError(f"{what} {k}: there are views 1 .. {count}")


def _order(values: Any) -> Order:
    check_object("order", values, KEYS)
    if values.get("schema", SCHEMA) != SCHEMA:
        raise UsageError(f"schema = {quote(values['schema'])} must be {SCHEMA!r}")
    given = {k: v for k, v in values.items() if v is not None and k != "schema"}
    names = _list("views", given.get("views"), "file names")
    if not LEAST_VIEWS <= len(names) <= MOST_VIEWS:
        raise UsageError(f"views has {len(names)} entries; {LEAST_VIEWS} .. {MOST_VIEWS} are taken")
    given["views"] = tuple(_path("views", name) for name in names)
    readers: dict[str, Callable[[str, Any], Any]] = {
        "geometry": _geometry, "masks": _masks, "landmarks": _landmarks, "frames": _frames,
        "edits": parse_edits, "regions": parse_regions, "ostia": _landmarks,
        "same_branch": _landmarks,
        "deleted_mm": _deleted, "lesions": _lesions, "drawn_on": parse_digests,
        "pixel_spacing_mm": number, "sod_mm": number, "deadline_s": number, "strict": _truth,
        "force": _truth, "allow_rescale": _truth, "out": _path, "extras": _texts,
    }  # fmt: skip
    for key, read in readers.items():
        if key in given:
            given[key] = read(key, given[key])
    order = Order(**given)
    check_view_numbers(order)
    return order


def _list(key: str, value: Any, of: str) -> list[Any]:
    if not isinstance(value, list):
        raise UsageError(f"{key} = {quote(value)} must be a list of {of}")
    return value


def _path(key: str, value: Any) -> Path:
    if not isinstance(value, str) or not value or "\0" in value:
        raise UsageError(f"{key} = {quote(value)} must be the name of a file or folder")
    try:
        # Half of a pair of surrogates names nothing.
        os.fsencode(value)
    except UnicodeEncodeError:
        raise UsageError(f"{key} = {quote(value)} has characters that no name has") from None
    return Path(value)


def _geometry(key: str, value: Any) -> Any:
    if isinstance(value, dict):
        return value
    if not isinstance(value, str):
        raise UsageError(f"{key} must be the content of a geom.json, or a file name")
    return _path(key, value)


def _masks(key: str, value: Any) -> dict[int, Path]:
    return {k: _path(f"{key}.{k}", name) for k, name in by_view(key, value, "file").items()}


def _landmarks(key: str, value: Any) -> tuple[Landmark, ...]:
    return tuple(
        tuple(
            None if point is None else parse_point(key, point)
            for point in _list(key, one, "points")
        )
        for one in _list(key, value, "points marked in the views")
    )


def _deleted(key: str, value: Any) -> tuple[tuple[float, float, float], ...]:
    places = [numbers(key, one, 3, _FARTHEST_MM) for one in _list(key, value, "places [x, y, z]")]
    return tuple((x, y, z) for x, y, z in places)


def _lesions(key: str, value: Any) -> tuple[LesionBorders, ...]:
    out = []
    for one in _list(key, value, "lesions"):
        check_object(key, one, ("view", "proximal", "distal"))
        missing = [name for name in ("view", "proximal", "distal") if name not in one]
        if missing:
            raise UsageError(f"{key}: {quote(one)} has no {missing[0]}")
        out.append(
            LesionBorders(
                view=whole(f"{key}.view", one["view"]),
                proximal=parse_point(f"{key}.proximal", one["proximal"]),
                distal=parse_point(f"{key}.distal", one["distal"]),
            )
        )
    return tuple(out)


def _frames(key: str, value: Any) -> tuple[int | None, ...]:
    entries = _list(key, value, "frames")
    return tuple(None if frame is None else whole(key, frame) for frame in entries)


def _truth(key: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise UsageError(f"{key} = {quote(value)} must be true or false")
    return value


def _texts(key: str, value: Any) -> tuple[Any, ...]:
    return tuple(_list(key, value, "names"))


def _given(order: Order, *keys: str) -> dict[str, Any]:
    """Those of the order's fields that say something, as keyword arguments."""
    found = {key: getattr(order, key) for key in keys}
    return {key: value for key, value in found.items() if value is not None}


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Stroke):
        return value.to_dict()
    if isinstance(value, tuple):
        return [_plain(one) for one in value]
    if isinstance(value, LesionBorders):
        return _plain(dataclasses.asdict(value))
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    return value


def _as_usage(check: Callable[..., None], *arguments: Any) -> None:
    try:
        check(*arguments)
    except GeometryError as error:
        raise UsageError(str(error)) from None
