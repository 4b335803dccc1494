"""Generated angiograms with their masks: trees of the generator over what else is in a picture.

Soft anatomy, spine, ribs and diaphragm; a catheter from the border to the ostium; guide wires,
sternal wires, electrodes; contrast that thins out along the tree; motion; collimator; quanta,
focal spot and detector; gamma, edge enhancement, 8-bit window and JPEG of the display.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from scipy import ndimage

from gcar_deploy.config import ImagingOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging import enhance
from gcar_deploy.imaging.net import prepared
from gcar_deploy.types import Array, Image, Mask
from gcar_export.raw_pictures import RawOptions, _anatomy
from gcar_export.render import path_lengths
from gcar_export.trees import SyntheticTree, random_tree

#: pixels along each side, and how much vessel a pixel of the mask holds at least, pixels
SIDE = 256
MASK_PIXELS = 0.8


@dataclasses.dataclass(frozen=True, eq=False)
class GeneratedAngiogram:
    """One picture with its truth.

    Attributes
    ----------
    pixels : (SIDE, SIDE) uint8, vessels dark
    mask : (SIDE, SIDE) bool, coronary vessels alone
    pixel_mm : float, at the isocentre
    """

    pixels: Array
    mask: Mask
    pixel_mm: float


def generated_angiogram(seed: int, index: int) -> GeneratedAngiogram:
    """Picture ``index`` of a stream; the same for the same arguments."""
    rng = np.random.default_rng([seed, index])
    tree = random_tree(rng).sides("left" if rng.random() < 0.65 else "right")
    pixel_mm = float(rng.uniform(0.28, 0.6))
    carm = _view(rng, pixel_mm)
    path, ostium = _filled(rng, tree, carm)
    mask = path > MASK_PIXELS * pixel_mm
    path = _moved(rng, path)
    anatomy = _anatomy(path.shape, rng, _background(rng))
    absorbed = rng.uniform(0.04, 0.14) * path + anatomy + _devices(rng, ostium, pixel_mm)
    pixels, field = _exposed(rng, absorbed)
    return GeneratedAngiogram(_displayed(rng, pixels, field), mask & field, pixel_mm)


def training_pair(seed: int, index: int, options: ImagingOptions) -> tuple[Array, Array]:
    """Return the network's input (2, SIDE, SIDE) and truth (SIDE, SIDE) float32 of a picture.

    The input is made by the code that makes it at run time, collimator search included.
    """
    made = generated_angiogram(seed, index)
    pixels = made.pixels.astype(np.float32)
    holes = enhance.collimator(pixels)
    picture = enhance.absorbance(pixels, options.log_offset)
    # Vessels have a known size only as far as the field is known: tell it a little wrong.
    told_mm = made.pixel_mm * float(np.random.default_rng([seed, index, 1]).uniform(0.85, 1.6))
    channels = prepared(picture, holes, told_mm, options)
    truth = (made.mask & ~holes).astype(np.float32)
    flip = np.random.default_rng([seed, index, 2]).integers(0, 2, 2)
    for axis in range(2):
        if flip[axis]:
            channels, truth = np.flip(channels, axis + 1), np.flip(truth, axis)
    return np.ascontiguousarray(channels), np.ascontiguousarray(truth)


def _view(rng: np.random.Generator, pixel_mm: float) -> CArm:
    sod, sdd = rng.uniform(700, 820), rng.uniform(950, 1200)
    spacing = pixel_mm * sdd / sod
    middle = (SIDE - 1) / 2
    return CArm(
        primary_angle_deg=float(rng.uniform(-60, 60)),
        secondary_angle_deg=float(rng.uniform(-35, 35)),
        sod_mm=float(sod),
        sdd_mm=float(sdd),
        rows=SIDE,
        columns=SIDE,
        pixel_spacing_mm=(spacing, spacing),
        principal_point_px=(
            float(middle + rng.uniform(-30, 30)),
            float(middle + rng.uniform(-30, 30)),
        ),
    )


def _filled(rng: np.random.Generator, tree: SyntheticTree, carm: CArm) -> tuple[Image, Array]:
    """Path lengths with contrast thinning out branch by branch; (col, row) of the ostium."""
    swell = rng.uniform(0.75, 1.4)
    path = np.zeros((SIDE, SIDE))
    groups: dict[float, list[int]] = {}
    for k in range(len(tree.vessels)):
        groups.setdefault(1.0 if k == 0 else float(rng.choice([1.0, 1.0, 0.7, 0.45])), []).append(k)
    for strength, members in groups.items():
        part = dataclasses.replace(tree, vessels=tuple(tree.vessels[k] for k in members))
        starts, ends, radii = part.segments()
        path = np.maximum(path, strength * path_lengths(carm, starts, ends, swell * radii))
    return path.astype(np.float32), carm.project(tree.vessels[0].points_mm[:1])[0][0]


def _moved(rng: np.random.Generator, path: Image) -> Image:
    """Blur along one direction: the heart moves during the exposure."""
    length = rng.uniform(0, 4)
    if length < 1:
        return path
    angle = rng.uniform(0, np.pi)
    kernel = np.zeros((9, 9), np.float32)
    half = 0.5 * length * np.array([np.cos(angle), np.sin(angle)])
    first, last = (tuple(int(x) for x in np.rint(16 * (4 + s * half))) for s in (-1, 1))
    cv2.line(kernel, first, last, 1.0, 1, cv2.LINE_AA, 4)
    return cv2.filter2D(path, -1, kernel / kernel.sum())


def _background(rng: np.random.Generator) -> RawOptions:
    return RawOptions(
        background=float(rng.uniform(0.05, 0.3)),
        spine=float(rng.uniform(0, 0.25)),
        rib=float(rng.uniform(0, 0.1)),
        diaphragm=float(rng.uniform(0, 0.6) * (rng.random() < 0.3)),
    )


def _devices(rng: np.random.Generator, ostium: Array, pixel_mm: float) -> Image:
    """Attenuation of catheter, wires, sternal wires and electrodes; none of them is vessel."""
    out = np.zeros((SIDE, SIDE), np.float32)
    if rng.random() < 0.8:
        side = rng.uniform(0, SIDE, 2)
        side[rng.integers(2)] = rng.choice([-5.0, SIDE + 5.0])
        bend = 0.5 * (ostium + side) + rng.normal(0, 40, 2)
        width = rng.uniform(1.6, 2.6) / pixel_mm
        _stroke(out, [side, bend, ostium], width, rng.uniform(0.08, 0.35))
    for _ in range(rng.poisson(0.7)):  # guide wires, pacing leads
        points = rng.uniform(-20, SIDE + 20, (4, 2))
        _stroke(out, list(points), rng.uniform(0.3, 1.0) / pixel_mm, rng.uniform(0.1, 0.6))
    if rng.random() < 0.2:  # sternal wires
        at = rng.uniform(0, SIDE)
        for row in np.arange(rng.uniform(0, 40), SIDE, rng.uniform(40, 80)):
            turn = rng.uniform(-9, 9, (4, 2)) + np.array([at, row])
            _stroke(out, [*turn, turn[0]], 0.9 / pixel_mm, 0.7)
    if rng.random() < 0.5:  # border of lung, heart or diaphragm
        row, col = np.indices(out.shape) / SIDE - rng.uniform(0.2, 0.8, 2)[:, None, None]
        turn = rng.uniform(0, 2 * np.pi)
        along, off = (
            row * np.cos(turn) + col * np.sin(turn),
            col * np.cos(turn) - row * np.sin(turn),
        )
        edge = off - rng.uniform(-1, 1) * along**2
        out += np.float32(rng.uniform(0.05, 0.7)) / (1 + np.exp(-edge / rng.uniform(0.003, 0.03)))
    for _ in range(rng.integers(0, 14)):  # twigs too thin for anyone to draw
        walk = np.cumsum(rng.normal(0, 9, (6, 2)), axis=0) + rng.uniform(0, SIDE, 2)
        _stroke(out, list(walk), 0.4 / pixel_mm, rng.uniform(0.01, 0.08))
    for _ in range(rng.poisson(0.25)):  # electrodes
        center = tuple(int(x) for x in rng.uniform(0, SIDE, 2))
        cv2.circle(out, center, int(rng.uniform(3, 7) / pixel_mm), rng.uniform(0.1, 0.4), -1)
    return cv2.GaussianBlur(out, (0, 0), 0.7)


def _stroke(out: Image, corners: list, width_px: float, strength: float) -> None:
    """Draw a smooth curve of even width through (col, row) corners."""
    corners = np.asarray(corners, float)
    t = np.linspace(0, len(corners) - 1, 200)
    line = np.stack([np.interp(t, np.arange(len(corners)), c) for c in corners.T], 1)
    line = ndimage.gaussian_filter1d(line, 18, axis=0, mode="nearest")
    canvas = np.zeros_like(out)
    points, width = np.rint(line * 16).astype(np.int32), max(1, round(width_px))
    cv2.polylines(canvas, [points], False, 1.0, width, cv2.LINE_AA, 4)
    out += np.float32(strength) * canvas


def _exposed(rng: np.random.Generator, absorbed: Image) -> tuple[Image, Mask]:
    """Quanta behind patient and collimator; the field that the collimator leaves open."""
    field = np.ones((SIDE, SIDE), bool)
    kind = rng.random()
    if kind < 0.35:
        edges = rng.integers(0, 22, 4)
        field[:] = False
        field[edges[0] : SIDE - edges[1], edges[2] : SIDE - edges[3]] = True
    elif kind < 0.5:
        row, col = np.indices(field.shape) - SIDE / 2
        field = np.hypot(row, col) < SIDE * rng.uniform(0.48, 0.6)
    shade = np.where(field, 0.0, rng.uniform(1.5, 4.0))
    light = np.exp(-(absorbed + shade))
    light = ndimage.gaussian_filter(light, rng.uniform(0.3, 1.1))
    quanta = rng.uniform(150, 3000)
    counts = rng.poisson(quanta * light) / quanta
    return ndimage.gaussian_filter(counts, rng.uniform(0.3, 0.9)).astype(np.float32), field


def _displayed(rng: np.random.Generator, light: Image, field: Mask) -> Array:
    """Gamma or logarithm, edge enhancement, window, 8 bit, at times JPEG."""
    picture = light ** rng.uniform(0.5, 1.3) if rng.random() < 0.6 else np.log(light + 0.03)
    if rng.random() < 0.5:
        wide = ndimage.gaussian_filter(picture, rng.uniform(2, 8))
        picture = picture + rng.uniform(0.3, 1.2) * (picture - wide)
    low, high = np.quantile(picture[field], [rng.uniform(0, 0.02), 1 - rng.uniform(0, 0.03)])
    floor, top = rng.uniform(0, 70), rng.uniform(170, 255)
    grey = floor + (top - floor) * (picture - low) / max(float(high - low), 1e-9)
    out = np.clip(grey, 0, 255).round().astype(np.uint8)
    if rng.random() < 0.4:
        quality = int(rng.uniform(55, 95))
        _, data = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, quality])
        out = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    return out
