"""Chart of error against time as SVG: points, Pareto front, knee, and a second axis."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from html import escape

WIDTH, HEIGHT = 860, 520
LEFT, RIGHT, TOP, BOTTOM = 70, 232, 46, 62
#: colours that people with colour-blindness tell apart (Okabe and Ito)
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Point:
    """One setting: seconds, error in mm, the series it belongs to, and words for a tooltip."""

    seconds: float
    error_mm: float
    series: str
    text: str = ""


def tradeoff_svg(
    points: Sequence[Point],
    front: Sequence[Point],
    knee: Point | None,
    *,
    title: str,
    bound_mm: float | None = None,
) -> str:
    """Draw the chart.

    Parameters
    ----------
    points : all settings
    front : those on the Pareto front, by time
    knee : the one past which more work buys nothing
    title : str
    bound_mm : Cramer-Rao bound, the unit of the second axis; None leaves that out

    Returns
    -------
    one self-contained SVG document
    """
    x_ticks = _log_ticks(min(p.seconds for p in points), max(p.seconds for p in points))
    y_ticks = _log_ticks(min(p.error_mm for p in points), max(p.error_mm for p in points))
    sx = _scale(x_ticks[0], x_ticks[-1], LEFT, WIDTH - RIGHT)
    sy = _scale(y_ticks[0], y_ticks[-1], HEIGHT - BOTTOM, TOP)
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        f'width="{WIDTH}" height="{HEIGHT}" font-family="sans-serif" font-size="13">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>',
        f'<text x="{LEFT}" y="26" font-size="16">{escape(title)}</text>',
    ]
    bottom, right = HEIGHT - BOTTOM, WIDTH - RIGHT
    for t in x_ticks:
        out.append(_line(sx(t), TOP, sx(t), bottom, "#e4e4e4"))
        out.append(_text(sx(t), bottom + 18, _number(t), "middle"))
    for t in y_ticks:
        out.append(_line(LEFT, sy(t), right, sy(t), "#e4e4e4"))
        out.append(_text(LEFT - 8, sy(t) + 4, _number(t), "end"))
        if bound_mm:
            out.append(_text(right + 8, sy(t) + 4, _number(float(f"{t / bound_mm:.2g}")), "start"))
    out.append(f'<rect x="{LEFT}" y="{TOP}" width="{right - LEFT}" height="{bottom - TOP}" '
               'fill="none" stroke="#555"/>')  # fmt: skip
    out.append(_text((LEFT + right) / 2, HEIGHT - 20, "seconds per reconstruction, warm", "middle"))
    out.append(_upright(20, (TOP + bottom) / 2, "centreline error (RMS), mm"))
    bounded = False
    if bound_mm:
        out.append(_upright(right + 52, (TOP + bottom) / 2, "error / Cramér-Rao bound"))
        bounded = y_ticks[0] < bound_mm < y_ticks[-1]
        if bounded:
            out.append(_line(LEFT, sy(bound_mm), right, sy(bound_mm), "#777", dash="2 4"))
    if len(front) > 1:
        path = " ".join(f"{sx(p.seconds):.1f},{sy(p.error_mm):.1f}" for p in front)
        out.append(f'<polyline points="{path}" fill="none" stroke="#444" stroke-dasharray="6 4"/>')
    names = sorted({p.series for p in points})
    colour = {name: COLOURS[k % len(COLOURS)] for k, name in enumerate(names)}
    for p in points:
        out.append(
            f'<circle cx="{sx(p.seconds):.1f}" cy="{sy(p.error_mm):.1f}" r="4.5" '
            f'fill="{colour[p.series]}" fill-opacity="0.8"><title>{escape(p.text)}</title></circle>'
        )
    if knee is not None:
        out.append(_ring(sx(knee.seconds), sy(knee.error_mm), 10))
    out += _legend(names, colour, right + 86, bound=bounded, knee=knee is not None)
    return "\n".join([*out, "</svg>", ""])


def _ring(x: float, y: float, radius: float) -> str:
    return (
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="none" stroke="#000" '
        'stroke-width="2"/>'
    )


def _legend(
    names: Sequence[str], colour: dict[str, str], x: float, *, bound: bool, knee: bool
) -> list[str]:
    """Say what points, lines and the ring are, beside the chart: within it words lie on points."""
    out = [_text(x - 5, TOP + 10, "predictor + refiner", "start")]
    for k, name in enumerate(names):
        y = TOP + 34 + 22 * k
        out.append(f'<circle cx="{x}" cy="{y - 4}" r="4.5" fill="{colour[name]}"/>')
        out.append(_text(x + 12, y, name, "start"))
    y = TOP + 40 + 22 * len(names)
    out.append(_line(x - 6, y - 4, x + 8, y - 4, "#444", dash="6 4"))
    out.append(_text(x + 12, y, "Pareto front", "start"))
    if bound:
        y += 22
        out.append(_line(x - 6, y - 4, x + 8, y - 4, "#777", dash="2 4"))
        out.append(_text(x + 12, y, "Cramér-Rao bound", "start"))
    if knee:
        y += 22
        out.append(_ring(x + 1, y - 4, 7))
        out.append(_text(x + 12, y, "more work buys", "start"))
        out.append(_text(x + 12, y + 16, "nothing past here", "start"))
    return out


def _log_ticks(low: float, high: float) -> list[float]:
    """Ticks 1, 2, 5 times powers of ten that enclose low .. high."""
    low, high = max(low, 1e-6), max(high, 1e-6)
    marks = [
        m * 10.0**e
        for e in range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 1)
        for m in (1, 2, 5)
    ]
    first = max((m for m in marks if m <= low * 0.9), default=marks[0])
    last = min((m for m in marks if m >= high * 1.1), default=marks[-1])
    return [m for m in marks if first <= m <= last]


def _scale(low: float, high: float, start: float, stop: float) -> Callable[[float], float]:
    span = math.log(high / low) or 1.0
    return lambda v: start + (stop - start) * math.log(max(v, 1e-12) / low) / span


def _number(value: float) -> str:
    return f"{value:g}"


def _line(x1: float, y1: float, x2: float, y2: float, colour: str, dash: str = "") -> str:
    extra = f' stroke-dasharray="{dash}"' if dash else ""
    return (
        f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{colour}"{extra}/>'
    )


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _upright(x: float, y: float, text: str) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="middle" '
        f'transform="rotate(-90 {x:.1f} {y:.1f})">{escape(text)}</text>'
    )
