"""Picture of Pd/Pa against the distance from the ostium, as SVG that fits in a page."""

from __future__ import annotations

import html

import numpy as np

from gcar_deploy.flow import PressureDrop, VesselPressure
from gcar_deploy.output.colors import branch_color, css
from gcar_deploy.types import Array

_WIDTH, _HEIGHT = 760, 344
# The axis' title stands above its highest number, clear of it.
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 744, 32, 300
#: no more points a curve
_POINTS = 120
#: ... and no more than so many branches by their numbers
_NAMED = 12


def pressure_svg(drop: PressureDrop) -> str:
    """Draw every branch as far as its interval is narrow enough for a value.

    Lines are Pd/Pa, bands its interval; where nothing may be told, the picture says so, and it
    names the branches of whose far end nothing may.
    """
    shown = [(k, v) for k, v in enumerate(drop.vessels) if np.count_nonzero(v.told) > 1]
    reach = max((float(v.arc_mm[v.told][-1]) for _, v in shown), default=10.0)
    low = min((float(np.min(v.low[v.told])) for _, v in shown), default=0.5)
    bottom = min(0.9, max(0.0, np.floor(10 * low) / 10))
    x_step = next((s for s in (1, 2, 5, 10, 20, 50, 100) if reach / s <= 9), 200)
    y_step = 0.02 if 1 - bottom <= 0.1 else 0.1

    def x(mm: Array | float) -> Array:
        return np.asarray(_LEFT + (_RIGHT - _LEFT) * np.asarray(mm) / reach)

    def y(ratio: Array | float) -> Array:
        return np.asarray(_BOTTOM - (_BOTTOM - _TOP) * (np.asarray(ratio) - bottom) / (1 - bottom))

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" '
        'font-family="sans-serif" font-size="12">',
        f"<title>{html.escape(drop.assumed.sentence())}</title>",
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="#fff"/>',
    ]
    for value in np.arange(bottom, 1 + 1e-9, y_step):
        at = float(y(value))
        parts.append(
            f'<path d="M{_LEFT} {at:.1f}H{_RIGHT}" stroke="#d9dee6"/>'
            f'<text x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{value:.2f}</text>'
        )
    for value in np.arange(0, reach + 1e-9, x_step):
        at = float(x(value))
        parts.append(f'<text x="{at:.1f}" y="{_BOTTOM + 17}" text-anchor="middle">{value:g}</text>')
    parts.append(
        f'<text x="{_RIGHT}" y="{_HEIGHT - 8}" text-anchor="end">mm from the ostium</text>'
        f'<text x="4" y="12">Pd/Pa (dimensionless), {drop.assumed.coverage:.0%} interval</text>'
    )
    for k, vessel in shown:
        parts += _curve(k, vessel, x, y)
    withheld = [str(k + 1) for k, v in enumerate(drop.vessels) if v.withheld]
    if shown and withheld:
        some = ", ".join(withheld[:_NAMED]) + (", ..." if len(withheld) > _NAMED else "")
        whose = "branch" if len(withheld) == 1 else "branches"
        parts.append(
            f'<text x="4" y="{_HEIGHT - 8}">no value at the far end of {whose} {some}</text>'
        )
    if not shown:
        parts.append(
            f'<text x="{_WIDTH / 2}" y="{_HEIGHT / 2}" text-anchor="middle">no value may be told; '
            "the table says why</text>"
        )
    return "".join([*parts, "</svg>"])


def _curve(k: int, vessel: VesselPressure, x, y) -> list[str]:  # type: ignore[no-untyped-def]
    """Band, line and number of one branch."""
    keep = np.flatnonzero(vessel.told)
    keep = keep[np.unique(np.linspace(0, len(keep) - 1, min(len(keep), _POINTS)).astype(int))]
    color = css(branch_color(k)[::-1])
    at = x(vessel.arc_mm[keep])
    low, high, middle = (y(np.maximum(v[keep], 0)) for v in (vessel.low, vessel.high, vessel.ratio))
    band = _path(np.concatenate([at, at[::-1]]), np.concatenate([high, low[::-1]]))
    return [
        f'<path d="{band}Z" fill="{color}" fill-opacity="0.15"/>',
        # A dark edge: light colours are hardly seen on paper.
        f'<path d="{_path(at, middle)}" fill="none" stroke="#1c2430" stroke-width="3.5"/>'
        f'<path d="{_path(at, middle)}" fill="none" stroke="{color}" stroke-width="2"/>',
        f'<text x="{at[-1] - 2:.1f}" y="{middle[-1] - 4:.1f}" text-anchor="end">{k + 1}</text>',
    ]


def _path(x: Array, y: Array) -> str:
    return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True))
