"""What is behind the vessels of a generated angiogram, and what the machine makes of it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy import ndimage

from gcar_deploy.types import Array, Image, Mask
from gcar_export.scenes.raw_pictures import RawOptions, _anatomy

#: pictures without any noise
NOISELESS = 0.2
#: guide wires and leads in a picture, on average
WIRES = 0.25


def scenery(rng: np.random.Generator, side: int, pixel_mm: float) -> tuple[Image, Image]:
    """(side, side) attenuation of the patient and of devices, without vessels and catheter."""
    ground = _subtracted if rng.random() < 0.2 else _patient
    out = ground(rng, side)
    devices = _devices(rng, side, pixel_mm)
    return out, np.asarray(cv2.GaussianBlur(devices, (0, 0), 0.7))


def _subtracted(rng: np.random.Generator, side: int) -> Image:
    """Return what a subtraction leaves: hardly any ground, but ghosts of what moved."""
    out = rng.uniform(0.01, 0.06) * _noise(rng, side, rng.uniform(0.1, 0.5) * side)
    for _ in range(rng.integers(0, 5)):
        edge = np.diff(_border(rng, side, rng.uniform(0.01, 0.03)), axis=0, prepend=0)
        out = out + rng.uniform(-1.5, 1.5) * edge
    return out.astype(np.float32)


def _patient(rng: np.random.Generator, side: int) -> Image:
    options = RawOptions(
        background=float(rng.uniform(0.03, 0.3)),
        spine=float(rng.uniform(0, 0.3) * (rng.random() < 0.5)),
        rib=float(rng.uniform(0, 0.12) * (rng.random() < 0.5)),
        diaphragm=float(rng.uniform(0.05, 0.7) * (rng.random() < 0.4)),
    )
    if rng.random() < 0.5:
        out = _anatomy((side, side), rng, options)
    else:  # smoother ground, as behind a picture that fills the screen
        out = rng.uniform(0.05, 0.4) * _noise(rng, side, rng.uniform(0.2, 0.5) * side)
        out = out + rng.uniform(0.01, 0.06) * _noise(rng, side, rng.uniform(0.04, 0.1) * side)
    for _ in range(rng.integers(0, 4)):  # lung, heart, diaphragm, spine: one smooth border each
        out = out + rng.uniform(0.05, 0.6) * _border(rng, side, rng.uniform(0.003, 0.06))
    # vessels of the lung and small ones of the heart, too fine to be followed
    fine = _noise(rng, side, rng.uniform(1.2, 4.0))
    if rng.random() < 0.5:
        fine = -np.abs(fine) * 1.5
    return (out + rng.uniform(0.0, 0.035) * fine).astype(np.float32)


def _noise(rng: np.random.Generator, side: int, scale_px: float) -> Array:
    """Smooth noise of unit variance."""
    coarse = max(1, int(scale_px / 4))
    size = max(8, -(-side // coarse) + 2)
    small = ndimage.gaussian_filter(
        rng.standard_normal((size, size)), scale_px / coarse, mode="wrap"
    )
    small = (small - small.mean()) / max(float(small.std()), 1e-9)
    large = cv2.resize(small, (size * coarse, size * coarse), interpolation=cv2.INTER_CUBIC)
    return large[:side, :side]


def _border(rng: np.random.Generator, side: int, softness: float) -> Array:
    """From 0 to 1 across a bent line."""
    row, col = np.indices((side, side)) / side - rng.uniform(0.1, 0.9, 2)[:, None, None]
    turn = rng.uniform(0, 2 * np.pi)
    along = row * np.cos(turn) + col * np.sin(turn)
    off = col * np.cos(turn) - row * np.sin(turn) - rng.uniform(-1.2, 1.2) * along**2
    off = off + rng.uniform(0, 0.02) * np.sin(2 * np.pi * rng.uniform(1, 4) * along)
    return 1 / (1 + np.exp(np.clip(-off / softness, -50, 50)))


def _devices(rng: np.random.Generator, side: int, pixel_mm: float) -> Image:
    """Attenuation of wires, leads, sternal wires, clips and electrodes."""
    out = np.zeros((side, side), np.float32)
    for _ in range(rng.poisson(WIRES)):  # guide wires, pacing leads, coils of a defibrillator
        points = rng.uniform(-20, side + 20, (4, 2))
        strength = rng.uniform(0.1, 0.6)
        _stroke(out, list(points), rng.uniform(0.3, 1.8) / pixel_mm, strength)
        if rng.random() < 0.3:
            _stroke(out, list(points[1:3]), rng.uniform(1.5, 3.0) / pixel_mm, strength)
    for _ in range(rng.poisson(0.3)):  # clips
        at, way = rng.uniform(0, side, 2), rng.normal(0, 2.5 / pixel_mm, 2)
        _stroke(out, [at, at + way], 1.0 / pixel_mm, rng.uniform(0.3, 1.0))
    if rng.random() < 0.1:  # sternal wires
        column = rng.uniform(0, side)
        for row in np.arange(rng.uniform(0, 40), side, rng.uniform(40, 80)):
            turn = rng.uniform(-9, 9, (4, 2)) + np.array([column, row])
            _stroke(out, [*turn, turn[0]], 0.9 / pixel_mm, 0.7)
    for _ in range(rng.poisson(0.15)):  # electrodes
        center = tuple(int(x) for x in rng.uniform(0, side, 2))
        cv2.circle(out, center, int(rng.uniform(2, 7) / pixel_mm), rng.uniform(0.1, 0.4), -1)
    return out


def _stroke(out: Image, corners: Sequence[Array], width_px: float, strength: float) -> None:
    """Draw a smooth curve of even width through (col, row) corners."""
    points = np.asarray(corners, float)
    t = np.linspace(0, len(points) - 1, 200)
    line = np.stack([np.interp(t, np.arange(len(points)), c) for c in points.T], 1)
    line = ndimage.gaussian_filter1d(line, 18, axis=0, mode="nearest")
    canvas = np.zeros_like(out)
    fixed, width = np.rint(line * 16).astype(np.int32), max(1, round(width_px))
    cv2.polylines(canvas, [fixed], False, 1.0, width, cv2.LINE_AA, 4)
    out += np.float32(strength) * canvas


def moved(rng: np.random.Generator, picture: Image) -> Image:
    """Blur along one direction: the heart moves during the exposure."""
    length = rng.uniform(0, 4)
    if length < 1:
        return picture
    angle = rng.uniform(0, np.pi)
    kernel = np.zeros((9, 9), np.float32)
    half = 0.5 * length * np.array([np.cos(angle), np.sin(angle)])
    first, last = (tuple(int(x) for x in np.rint(16 * (4 + s * half))) for s in (-1, 1))
    cv2.line(kernel, first, last, 1.0, 1, cv2.LINE_AA, 4)
    return np.asarray(cv2.filter2D(picture, -1, kernel / kernel.sum()))


def exposed(rng: np.random.Generator, absorbed: Image) -> tuple[Image, Mask]:
    """Quanta behind patient and collimator; the field that the collimator leaves open."""
    side = absorbed.shape[0]
    field = np.ones((side, side), bool)
    kind = rng.random()
    if kind < 0.2:
        edges = rng.integers(0, 22, 4)
        field[:] = False
        field[edges[0] : side - edges[1], edges[2] : side - edges[3]] = True
    elif kind < 0.5:
        row, col = (
            np.indices(field.shape) - side * (0.5 + rng.uniform(-0.15, 0.15, 2))[:, None, None]
        )
        field = np.hypot(row, col) < side * rng.uniform(0.48, 0.75)
    shade = np.where(field, 0.0, rng.uniform(1.5, 4.0))
    light = ndimage.gaussian_filter(np.exp(-(absorbed + shade)), rng.uniform(0.2, 1.1))
    if rng.random() < NOISELESS:
        return light.astype(np.float32), field
    quanta = float(np.exp(rng.uniform(np.log(60), np.log(20000))))
    counts = rng.poisson(quanta * light) / quanta
    return ndimage.gaussian_filter(counts, rng.uniform(0.2, 1.0)).astype(np.float32), field


def displayed(rng: np.random.Generator, light: Image, field: Mask) -> Array:
    """Gamma or logarithm, edges enhanced, window, text, 8 bit; at times JPEG or too few pixels."""
    picture = light ** rng.uniform(0.4, 1.5) if rng.random() < 0.6 else np.log(light + 0.03)
    if rng.random() < 0.5:
        wide = ndimage.gaussian_filter(picture, rng.uniform(1.5, 8))
        picture = picture + rng.uniform(0.2, 2.0) * (picture - wide)
    cut = 0.08 if rng.random() < 0.15 else 0.02
    low, high = np.quantile(picture[field], [rng.uniform(0, cut), 1 - rng.uniform(0, 1.5 * cut)])
    floor, top = rng.uniform(0, 80), rng.uniform(110, 255)
    grey = floor + (top - floor) * (picture - low) / max(float(high - low), 1e-9)
    out = np.clip(grey, 0, 255).round().astype(np.uint8)
    if rng.random() < 0.08:
        _write(rng, out)
    if rng.random() < 0.12:
        out = _coarse(out, float(rng.uniform(1.2, 2.5)))
    if rng.random() < 0.4:
        quality = int(rng.uniform(30, 95))
        _, data = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, quality])
        out = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    return out


def _write(rng: np.random.Generator, out: Array) -> None:
    """Burn letters in, white or black, in a corner or anywhere."""
    side = out.shape[0]
    size, colour = rng.uniform(0.25, 0.7), int(rng.choice([0, 255]))
    for _ in range(rng.integers(1, 4)):
        letters = "".join(chr(c) for c in rng.integers(48, 91, rng.integers(2, 10)))
        col, row = (int(x) for x in rng.uniform(0, (0.8 * side, side)))
        cv2.putText(out, letters, (col, row), cv2.FONT_HERSHEY_SIMPLEX, size, colour)


def _coarse(out: Array, factor: float) -> Array:
    """Take pixels away and blow the rest up again, as a small picture is before it is looked at."""
    side = out.shape[0]
    few = max(8, round(side / factor))
    small = cv2.resize(out, (few, few), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(small, (side, side), interpolation=cv2.INTER_LINEAR))
