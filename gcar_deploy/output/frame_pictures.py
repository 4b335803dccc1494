"""Chosen frames as PNG, and the picture of how all frames of two runs go together."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.imaging.chosen_frame import FramePair
from gcar_deploy.output.overlay import grey8, png_bytes
from gcar_deploy.types import Array, Image

_FONT, _INK = cv2.FONT_HERSHEY_SIMPLEX, (40, 40, 40)
_SIDE, _LEFT, _TOP, _BELOW, _GAP = 512, 96, 48, 92, 32
#: why a pair was not to be taken: see ``choose_pair``
_PALE = "pale: not filled, not still, no R wave, or not the frame asked for"
#: width of the colour scale and of its labels
_SCALE = 110


def frame_png(angiogram: Angiogram) -> bytes:
    """PNG of a picture, counts as they were decoded; see ``counts_png``."""
    return counts_png(angiogram.pixels, angiogram.bit_depth)


def counts_png(pixels: Image, bit_depth: int) -> bytes:
    """PNG of (rows, cols) counts of 8 or 16 bit; of deeper ones what a screen shows."""
    if bit_depth > 16:
        return png_bytes(grey8(pixels))
    deep = np.uint8 if bit_depth <= 8 else np.uint16
    return png_bytes(np.clip(np.rint(pixels), 0, np.iinfo(deep).max).astype(deep))


def pairs_png(
    pair: FramePair, pictures: tuple[Image, Image], frame_ms: Sequence[float | None]
) -> bytes:
    """PNG: scores of all pairs (rows: run 1, columns: run 2), and the chosen frames beside them.

    Parameters
    ----------
    pictures : (rows, cols) counts of the chosen frame of each run
    frame_ms : time from frame to frame of both runs, None where it is not known
    """
    n, m = pair.scores.shape
    cell = max(2, min(_SIDE // n, _SIDE // m))
    height, width = n * cell, m * cell
    margin = "-" if pair.margin is None else f"{pair.margin:.2f}"
    i, j = pair.chosen
    said = [f"frames {i + 1} and {j + 1}: score {pair.score:.2f}, margin {margin}"]
    if not pair.remaining.all():
        said.append(_PALE)
    # Runs of few frames make a narrow table; words stand below it whole.
    wide = max(_LEFT + width + _SCALE, _LEFT + max(map(_width, said)) + _GAP)
    canvas = np.full((_TOP + max(height, _SIDE) + _BELOW, wide, 3), 255, np.uint8)
    low, high = float(pair.scores.min()), float(pair.scores.max())
    shade = np.rint(255 * (pair.scores - low) / max(high - low, 1e-9)).astype(np.uint8)
    colour = cv2.applyColorMap(shade, cv2.COLORMAP_VIRIDIS)
    # What was not to be taken is paler.
    colour = np.where(pair.remaining[..., None], colour, 0.4 * colour + 0.6 * 255).astype(np.uint8)
    canvas[_TOP : _TOP + height, _LEFT : _LEFT + width] = cv2.resize(
        colour, (width, height), interpolation=cv2.INTER_NEAREST
    )
    at = (_LEFT + j * cell, _TOP + i * cell)
    cv2.rectangle(canvas, at, (at[0] + cell, at[1] + cell), (0, 0, 255), 2)
    for k in _ticks(m):
        _write(canvas, str(k), (_LEFT + round((k - 0.5) * cell) - 6, _TOP + height + 18))
    for k in _ticks(n):
        _write(canvas, str(k), (_LEFT - 30, _TOP + round((k - 0.5) * cell) + 5))
    _write(canvas, _axis("run 2: frame", frame_ms[1]), (_LEFT, _TOP + height + 42))
    _write(canvas, _axis("run 1: frame (down)", frame_ms[0]), (_LEFT, _TOP - 12))
    _scale(canvas, (_LEFT + width + 16, _TOP, height), (low, high))
    for k, text in enumerate(said):
        _write(canvas, text, (_LEFT, _TOP + height + 64 + 20 * k))
    parts = [canvas]
    for number, (picture, frame) in enumerate(zip(pictures, (i, j), strict=True), start=1):
        parts.append(_framed(picture, f"run {number}, frame {frame + 1}", canvas.shape[0]))
    return png_bytes(np.concatenate(parts, axis=1))


def _framed(picture: Image, title: str, height: int) -> Array:
    grey = grey8(picture)
    scale = _SIDE / max(grey.shape)
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    out = np.full((height, small.shape[1] + _GAP, 3), 255, np.uint8)
    out[_TOP : _TOP + small.shape[0], : small.shape[1]] = small[..., None]
    _write(out, title, (0, _TOP - 12))
    return out


def _scale(canvas: Array, at: tuple[int, int, int], ends: tuple[float, float]) -> None:
    """Draw the colours from the highest to the lowest score."""
    left, top, height = at
    ramp = np.linspace(255, 0, height).astype(np.uint8)[:, None].repeat(16, axis=1)
    canvas[top : top + height, left : left + 16] = cv2.applyColorMap(ramp, cv2.COLORMAP_VIRIDIS)
    _write(canvas, f"{ends[1]:.2f}", (left + 20, top + 10))
    _write(canvas, f"{ends[0]:.2f}", (left + 20, top + height))
    _write(canvas, "score", (left + 20, top + height // 2))


def _axis(text: str, frame_ms: float | None) -> str:
    return text if frame_ms is None else f"{text} ({frame_ms:.0f} ms each)"


def _ticks(count: int) -> list[int]:
    step = max(1, -(-count // 10))
    return list(range(1, count + 1, step))


def _width(text: str) -> int:
    return int(cv2.getTextSize(text, _FONT, 0.5, 1)[0][0])


def _write(canvas: Array, text: str, at: tuple[int, int]) -> None:
    cv2.putText(canvas, text, at, _FONT, 0.5, _INK, 1, cv2.LINE_AA)
