"""Catheters, leads, wires, coils and clips of every calibre and course, drawn into any picture.

Devices are drawn wider than they are met: how a line runs and how even it is should tell that it
is none of the patient's, whatever its calibre and its contrast.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from gcar_deploy.types import Array, Image
from gcar_export.scenes.angiogram_vessels import ribbon

#: devices in a picture that has any, at most
MOST = 3
#: diameter as a share of the picture's side (0.3 to 4 mm of fields of 100 to 200 mm), and how much
#: of the light one takes in its middle
WIDTH, TAKEN = (0.003, 0.024), (0.06, 0.5)
#: of the tubes this share shows its walls more than its lumen
_HOLLOW = 0.25
_STEPS = 240


def drawn_devices(rng: np.random.Generator, side: int) -> Image:
    """(side, side) float32, what devices absorb (natural logarithm), 0 beside them."""
    out = np.zeros((side, side), np.float32)
    for _ in range(int(rng.integers(1, MOST + 1))):
        width = side * float(np.exp(rng.uniform(*np.log(WIDTH))))
        taken = float(np.exp(rng.uniform(*np.log(TAKEN))))
        kind = rng.random()
        if kind < 0.1:
            _clips(rng, out, taken)
            continue
        line = _crossing(rng, side) if kind < 0.35 else _entering(rng, side)
        one = np.zeros_like(out)
        ribbon(one, line, width, 1.0)
        if rng.random() < _HOLLOW and width > 2:
            lumen = np.zeros_like(out)
            ribbon(lumen, line, 0.6 * width, float(rng.uniform(0.3, 0.9)))
            one *= 1 - lumen
        if rng.random() < 0.2:
            _electrodes(rng, one, line, width)
        out = np.maximum(out, taken * one)
    return np.asarray(cv2.GaussianBlur(out, (0, 0), float(rng.uniform(0.5, 1.1))))


def _entering(rng: np.random.Generator, side: int) -> Array:
    """(n, 2) (col, row): from a border to somewhere within, straight or with the bend of a tip."""
    start, inward = _at_border(rng, side)
    tip = rng.uniform(0.1, 0.9, 2) * side
    way = float(np.hypot(*(tip - start)))
    first = start + inward * way * rng.uniform(0.2, 0.6)
    sideways = np.array([start[1] - tip[1], tip[0] - start[0]]) * rng.normal(0, 0.35)
    line = _bezier(np.stack([start, first, 0.5 * (first + tip) + sideways, tip]))
    if rng.random() < 0.5:  # preshaped: one or two firm bends before the tip
        step = line[-1] - line[-6]
        line = np.concatenate([line, _tip(rng, side, line[-1], step / max(np.hypot(*step), 1e-9))])
    return line


def _tip(rng: np.random.Generator, side: int, at: Array, heading: Array) -> Array:
    """(n, 2) course that goes on from ``at`` along ``heading`` and bends in arcs."""
    count = int(rng.uniform(0.06, 0.3) * side)
    turns = np.zeros(count)
    for _ in range(int(rng.integers(1, 3))):
        where, long = rng.uniform(0, count), rng.uniform(3, 0.1 * side)
        bend = np.exp(-0.5 * ((np.arange(count) - where) / long) ** 2)
        turns += rng.choice([-1, 1]) * rng.uniform(0.4, 3.2) * bend / bend.sum()
    angle = np.arctan2(heading[1], heading[0]) + np.cumsum(turns)
    return np.asarray(at + np.cumsum(np.stack([np.cos(angle), np.sin(angle)], 1), axis=0))


def _crossing(rng: np.random.Generator, side: int) -> Array:
    """(n, 2) (col, row): from border to border."""
    (start, first), (end, second) = _at_border(rng, side), _at_border(rng, side)
    way = float(np.hypot(*(end - start)))
    inner = [
        start + first * way * rng.uniform(0.1, 0.6),
        end + second * way * rng.uniform(0.1, 0.6),
    ]
    line = _bezier(np.stack([start, *inner, end]))
    if rng.random() < 0.3:  # slack
        noise = rng.standard_normal((len(line), 2))
        smooth = ndimage.gaussian_filter1d(noise, rng.uniform(10, 40), axis=0, mode="nearest")
        line = line + rng.uniform(0, 0.03) * side * smooth / max(float(smooth.std()), 1e-9)
    return np.asarray(line)


def _at_border(rng: np.random.Generator, side: int) -> tuple[Array, Array]:
    """Point just outside one of the four borders, and a direction inward, both (col, row)."""
    along, lean = float(rng.uniform(0, side)), float(rng.normal(0, 0.5))
    edge = int(rng.integers(4))
    point = np.array([along, -6.0]) if edge < 2 else np.array([-6.0, along])
    inward = np.array([lean, 1.0]) if edge < 2 else np.array([1.0, lean])
    if edge % 2:
        point = np.where(point == -6.0, side + 6.0, point)
        inward = np.where(inward == 1.0, -1.0, inward)
    return point, inward / float(np.hypot(*inward))


def _bezier(corners: Array) -> Array:
    t = np.linspace(0, 1, _STEPS)[:, None]
    a, b, c, d = corners
    return np.asarray(
        (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * b + 3 * (1 - t) * t**2 * c + t**3 * d
    )


def _electrodes(rng: np.random.Generator, one: Image, line: Array, width: float) -> None:
    """Thicker pieces of a lead: rings, a coil, the tip."""
    for _ in range(int(rng.integers(1, 4))):
        k = int(rng.integers(len(line) - 4))
        piece = line[k : k + int(rng.integers(3, 40))]
        ribbon(one, piece, float(rng.uniform(1.2, 2.2)) * width, float(rng.uniform(1.0, 2.0)))


def _clips(rng: np.random.Generator, out: Image, taken: float) -> None:
    """Clips, or rings of sternal wire."""
    side = len(out)
    for _ in range(int(rng.integers(1, 5))):
        at = rng.uniform(0, side, 2)
        if rng.random() < 0.5:
            ends = at + rng.normal(0, 0.01 * side, (2, 2))
        else:
            turn = np.linspace(0, 2 * np.pi, 30)
            reach = rng.uniform(0.01, 0.035, 2) * side
            ends = at + reach * np.stack([np.cos(turn), np.sin(turn)], 1)
        ribbon(out, ends, float(rng.uniform(1.2, 3.0)), 1.5 * taken)
