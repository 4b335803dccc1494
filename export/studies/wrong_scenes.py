"""Scenes that are wrong on purpose, made of generated trees, and what of the error shows.

An examination is a left or right tree (generated), seen in two or three of the clinical views,
each turned by some degrees, as exact path lengths, as masks, or as clean raw pictures (contrast
0.15 / mm, background 0.07, 5000 quanta). ``wrong_scenes`` spoils it in every way of ``CHANGES``.

How an error shows (``shows``):

========= =====================================================================================
rays      the rays of the true centreline's points miss each other by more than ``SHOWN_PX``
          pixels (root mean square over points and views, after the best triangulation)
width     path lengths contradict the width of the shadows by a tenth and more
size      calibre and extent are not human: the scale is off by half and more
content   the pictures are of two patients, or one picture was given twice
anatomy   pictures or signs are turned such that the views agree: the tree is a mirror image or
          stands on its head
shape     the file's size contradicts the geometry
nothing   in principle invisible: a tree explains the pictures as well as the right one does
========= =====================================================================================
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping

import cv2
import numpy as np

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.epipolar import triangulate
from gcar_deploy.geometry.scene import Intensity, Scene, View
from gcar_deploy.types import Array, Pixels, Points
from gcar_export.scenes.protocols import MASK_PATH_MM, MM_PER_COUNT, clinical_geometry
from gcar_export.scenes.raw_pictures import RawOptions, raw_picture
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.trees import SIDES, SyntheticTree, random_tree

PICTURES = ("path_length", "mask", "raw")
VIEWS = (2, 3)
#: clean raw pictures
RAW = RawOptions(contrast_per_mm=0.15, background=0.07, photons=5000.0)
#: views stand so far from the usual directions, standard deviation, degrees
SPREAD_DEG = 5.0
#: rays that miss each other by less than this do not show, pixels
SHOWN_PX = 1.0
#: column and row of a picture's point before -> after a change of its pixels
Moves = Callable[[Pixels], Pixels]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Told:
    """What a reconstruction is given.

    Attributes
    ----------
    carms : V views as the geometry tells them
    images : V pictures
    moves : V functions that say where a point of the true picture stands in the one given
    mm_per_count : of path lengths
    """

    carms: tuple[CArm, ...]
    images: tuple[Array, ...]
    moves: tuple[Moves, ...]
    mm_per_count: float = MM_PER_COUNT

    def view(self, k: int, **how: object) -> Told:
        """Return this with view ``k`` (from the end too) told otherwise."""
        carms = list(self.carms)
        carms[k] = dataclasses.replace(carms[k], **how)  # type: ignore[arg-type]
        return dataclasses.replace(self, carms=tuple(carms))

    def picture(self, k: int, change: Callable[[Array], Array], move: Moves) -> Told:
        """Return this with the pixels of picture ``k`` changed."""
        images, moves = list(self.images), list(self.moves)
        images[k], moves[k] = np.ascontiguousarray(change(images[k])), move
        return dataclasses.replace(self, images=tuple(images), moves=tuple(moves))

    def every(self, change: Callable[[Told, int], Told]) -> Told:
        """Return this with every view changed alike."""
        told = self
        for k in range(len(self.carms)):
            told = change(told, k)
        return told


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Exam:
    """One right examination.

    Attributes
    ----------
    name : seed, number and side of the tree
    pictures : of ``PICTURES``
    tree, other : the patient, and another one
    line_mm : (n, 3) points of the true centreline
    told : the right scene
    rng : for what a change draws
    """

    name: str
    pictures: str
    tree: SyntheticTree
    other: SyntheticTree
    line_mm: Points
    told: Told
    rng: np.random.Generator

    def scene(self, told: Told) -> Scene:
        """Return the geometry that goes with the pictures."""
        exact = self.pictures == "path_length"
        intensity = Intensity(
            kind=self.pictures, polarity="dark" if self.pictures == "raw" else "bright",
            mm_per_count=told.mm_per_count if exact else None,
        )  # fmt: skip
        views = tuple(
            View(id=str(k + 1), carm=carm, intensity=intensity) for k, carm in enumerate(told.carms)
        )
        return Scene(views=views, grid=clinical_geometry(2)[2])


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class WrongScene:
    """A scene, what is wrong in it, and how that shows (see the head of this file)."""

    family: str
    name: str
    told: Told
    shows: str


def exam(seed: int, number: int, pictures: str, views: int) -> Exam:
    """Simulate the right examination of tree ``number``: even ones are left, odd ones right."""
    rng = np.random.default_rng([seed, number, PICTURES.index(pictures), views])
    side = SIDES[number % 2]
    tree, other = (
        random_tree(np.random.default_rng([seed, k])).sides(side) for k in (number, number + 7919)
    )
    carms = tuple(
        carm.turned(*(SPREAD_DEG * rng.normal(size=2))) for carm in clinical_geometry(views)[0]
    )
    images = tuple(picture_of(path_lengths(c, *tree.segments()), pictures, rng) for c in carms)
    return Exam(
        name=f"{seed}/{number} {side}", pictures=pictures, tree=tree, other=other,
        line_mm=tree.line(),
        told=Told(carms=carms, images=images, moves=(_stays,) * views), rng=rng,
    )  # fmt: skip


def picture_of(path_mm: Array, pictures: str, rng: np.random.Generator) -> Array:
    """Make the picture of one view of path lengths, mm."""
    if pictures == "raw":
        return raw_picture(path_mm, rng, RAW)
    if pictures == "mask":
        return np.uint8(255) * (path_mm >= MASK_PATH_MM)
    return np.clip(np.rint(path_mm / MM_PER_COUNT), 0, 65535).astype(np.uint16)


def wrong_scenes(case: Exam) -> Iterator[WrongScene]:
    """Spoil an examination in every way that its pictures allow."""
    for name, (family, shows, change) in CHANGES.items():
        if family == "mm_per_count" and case.pictures != "path_length":
            continue
        told = change(case)
        if shows == "rays":
            shows = "rays" if rays_miss_px(case, told) > SHOWN_PX else "nothing"
        elif shows == "rays or anatomy":
            shows = "rays" if rays_miss_px(case, told) > SHOWN_PX else "anatomy"
        elif shows == "width" and case.pictures != "path_length":
            shows = "nothing"
        yield WrongScene(family=family, name=name, told=told, shows=shows)


def rays_miss_px(case: Exam, told: Told) -> float:
    """Root mean square distance of the true points, triangulated as told, from their pixels."""
    points = case.line_mm[:: max(len(case.line_mm) // 300, 1)]
    pixels = [
        move(carm.project(points)[0])
        for carm, move in zip(case.told.carms, told.moves, strict=True)
    ]
    found, _ = triangulate(told.carms, pixels)
    gaps = [c.project(found)[0] - at for c, at in zip(told.carms, pixels, strict=True)]
    return float(np.sqrt(np.mean(np.sum(np.square(gaps), axis=2))))


# -- the changes ----------------------------------------------------------------------------


def _stays(pixels: Pixels) -> Pixels:
    return pixels


def _angle(key: str, by: float) -> Callable[[Exam], Told]:
    def change(case: Exam) -> Told:
        return case.told.view(-1, **{key: getattr(case.told.carms[-1], key) + by})

    return change


def _signs(*keys: str, last: bool = False) -> Callable[[Exam], Told]:
    def turned(told: Told, k: int) -> Told:
        return told.view(k, **{key: -getattr(told.carms[k], key) for key in keys})

    return lambda case: turned(case.told, -1) if last else case.told.every(turned)


def _flipped(columns: bool, rows: bool, last: bool = False) -> Callable[[Exam], Told]:
    def flip(told: Told, k: int) -> Told:
        height, width = told.images[k].shape
        signs = np.array([-1 if columns else 1, -1 if rows else 1])
        ends = np.array([width - 1 if columns else 0, height - 1 if rows else 0])
        step = (slice(None, None, int(signs[1])), slice(None, None, int(signs[0])))
        return told.picture(k, lambda image: image[step], lambda pixels: ends + signs * pixels)

    return lambda case: flip(case.told, -1) if last else case.told.every(flip)


def _quarter(case: Exam) -> Told:
    side = case.told.images[-1].shape[0] - 1
    return case.told.picture(
        -1, np.rot90, lambda pixels: np.stack([pixels[:, 1], side - pixels[:, 0]], axis=1)
    )


def _spacing(factor: float, last: bool = True) -> Callable[[Exam], Told]:
    def scaled(told: Told, k: int) -> Told:
        row, column = told.carms[k].pixel_spacing_mm
        return told.view(k, pixel_spacing_mm=(factor * row, factor * column))

    return lambda case: scaled(case.told, -1) if last else case.told.every(scaled)


def _distance(key: str, factor: float) -> Callable[[Exam], Told]:
    return lambda case: case.told.view(-1, **{key: factor * getattr(case.told.carms[-1], key)})


def _counts(factor: float) -> Callable[[Exam], Told]:
    return lambda case: dataclasses.replace(case.told, mm_per_count=factor * MM_PER_COUNT)


def _crop(share: float, resized: bool) -> Callable[[Exam], Told]:
    def change(case: Exam) -> Told:
        side = case.told.images[-1].shape[0]
        keep = int(share * side) // 2 * 2
        edge = (side - keep) // 2
        middle = (side - 1) / 2

        def cut(image: Array) -> Array:
            part = image[edge : edge + keep, edge : edge + keep]
            if not resized:
                return part
            whole = cv2.resize(part, (side, side), interpolation=cv2.INTER_LINEAR)
            return np.where(whole > 127, np.uint8(255), 0) if case.pictures == "mask" else whole

        return case.told.picture(-1, cut, lambda px: middle + (px - middle) * side / keep)

    return change


def _shifted(by_px: int) -> Callable[[Exam], Told]:
    return lambda case: case.told.picture(
        -1, lambda image: np.roll(image, by_px, axis=0), lambda px: px + np.array([0, by_px])
    )


def _swapped(case: Exam) -> Told:
    told = case.told
    return dataclasses.replace(told, images=(told.images[1], told.images[0], *told.images[2:]))


def _twice(change: Callable[[Array, np.random.Generator], Array]) -> Callable[[Exam], Told]:
    def given(case: Exam) -> Told:
        first = case.told.images[0]
        return case.told.picture(-1, lambda _: change(first, case.rng), _stays)

    return given


def _noisy(image: Array, rng: np.random.Generator) -> Array:
    top = np.iinfo(image.dtype).max
    spread = 0.02 * float(image.max())
    return np.clip(image + rng.normal(0, spread, image.shape), 0, top).astype(image.dtype)


def _re_encoded(image: Array, rng: np.random.Generator) -> Array:
    """Through 8 bits and JPEG, as from a presentation."""
    grey = (255 * (image / image.max())).astype(np.uint8)
    blob = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    again = np.asarray(cv2.imdecode(blob, cv2.IMREAD_UNCHANGED), dtype=np.float64)
    return np.rint(again / 255 * float(image.max())).astype(image.dtype)


def _two_patients(case: Exam) -> Told:
    path = path_lengths(case.told.carms[-1], *case.other.segments())
    return case.told.picture(-1, lambda _: picture_of(path, case.pictures, case.rng), _stays)


_PRIMARY, _SECONDARY = "primary_angle_deg", "secondary_angle_deg"
#: name -> family, how it shows ("rays": if they miss each other), change; "last view" is the second
#: or third
CHANGES: Mapping[str, tuple[str, str, Callable[[Exam], Told]]] = {
    **{
        f"{word} angle of the last view {by:+d} deg": ("angle", "rays", _angle(key, by))
        for word, key in (("secondary", _SECONDARY), ("primary", _PRIMARY))
        for by in (-10, -5, -3, 3, 5, 10)
    },
    "signs of all angles": ("frame", "rays or anatomy", _signs(_PRIMARY, _SECONDARY)),
    "signs of all primary angles": ("frame", "rays or anatomy", _signs(_PRIMARY)),
    "signs of all secondary angles": ("frame", "rays or anatomy", _signs(_SECONDARY)),
    "sign of the last view's secondary angle": ("angle", "rays", _signs(_SECONDARY, last=True)),
    "sign of the last view's primary angle": ("angle", "rays", _signs(_PRIMARY, last=True)),
    "all pictures mirrored": ("frame", "rays or anatomy", _flipped(True, False)),
    "all pictures upside down": ("frame", "rays or anatomy", _flipped(False, True)),
    "all pictures turned by 180 deg": ("frame", "rays or anatomy", _flipped(True, True)),
    "last picture mirrored": ("picture", "rays", _flipped(True, False, last=True)),
    "last picture upside down": ("picture", "rays", _flipped(False, True, last=True)),
    "last picture turned by 180 deg": ("picture", "rays", _flipped(True, True, last=True)),
    "last picture turned by 90 deg": ("picture", "rays", _quarter),
    "pictures 1 and 2 swapped": ("picture", "content", _swapped),
    **{f"mm_per_count x{f:g}": ("mm_per_count", "width", _counts(f)) for f in (0.5, 1.2, 2, 10)},
    **{
        f"spacing of the last view x{f:g}": ("scale of one", "rays", _spacing(f))
        for f in (0.9, 1.05, 1.1, 1.2)
    },
    "spacing of all views x1.1": ("scale of all", "width", _spacing(1.1, last=False)),
    "spacing of all views x2": ("scale of all", "size", _spacing(2, last=False)),
    "SDD of the last view x1.1": ("scale of one", "rays", _distance("sdd_mm", 1.1)),
    "SDD of the last view x0.9": ("scale of one", "rays", _distance("sdd_mm", 0.9)),
    "SOD of the last view x0.85": ("scale of one", "rays", _distance("sod_mm", 0.85)),
    "last picture cropped": ("crop", "shape", _crop(0.75, resized=False)),
    "last picture cropped and resized": ("crop", "rays", _crop(0.8, resized=True)),
    "last picture moved by 20 px": ("picture", "rays", _shifted(20)),
    "picture 1 twice, re-encoded": ("twice", "content", _twice(_re_encoded)),
    "picture 1 twice, moved by a pixel": (
        "twice", "content", _twice(lambda image, _: np.roll(image, 1, axis=1)),
    ),
    "picture 1 twice, noise added": ("twice", "content", _twice(_noisy)),
    "two patients": ("two patients", "content", _two_patients),
}  # fmt: skip
