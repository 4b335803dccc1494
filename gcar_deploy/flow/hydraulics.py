"""Closed forms of a vessel: Poiseuille's law with taper, and the loss behind a narrowing.

    dp = R Q + S Q |Q|

    R = 8 mu / pi  sum over pieces  length (a^2 + a b + b^2) / (3 a^3 b^3)
    S = 0.5 K rho (1 / A_throat - 1 / A_behind)^2,  K = 1.52

R is Poiseuille's law integrated over cones with end radii a and b. S is the turbulent term of Young
and Tsai (J Biomech 6:547, 1973) with the area behind the narrowing as the free one, as
svZeroDSolver has it. Curvature, entrance lengths and pulsation are left out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gcar_deploy.flow.assumption import EXPANSION_LOSS
from gcar_deploy.types import Array, Scalars

#: radii closer than this share are one width: such widenings cost below 0.05 mmHg at 0.35 m/s
LEAST_CHANGE = 0.1
_MM = 1e-3


class Expansion(NamedTuple):
    """Where a vessel is narrowest and where it has widened again: numbers of its points."""

    throat: int
    behind: int


def piece_resistance(radius_mm: Array, length_mm: Scalars, viscosity_pa_s: float) -> Array:
    """Poiseuille resistance of each piece between two points.

    Parameters
    ----------
    radius_mm : (..., m)
    length_mm : (m - 1,)

    Returns
    -------
    (..., m - 1) Pa s / m^3
    """
    a, b = radius_mm[..., :-1] * _MM, radius_mm[..., 1:] * _MM
    ab = a * b
    cone = (a * a + ab + b * b) / (3.0 * ab * ab * ab)  # a power would take five times as long
    out: Array = 8.0 * viscosity_pa_s / np.pi * length_mm * _MM * cone
    return out


def expansions(radius_mm: Scalars) -> tuple[Expansion, ...]:
    """Find each narrowing that the vessel widens behind, inlet first.

    A throat counts when the radius grows by ``LEAST_CHANGE`` behind it, until it falls by as much.
    """
    out: list[Expansion] = []
    throat = behind = 0
    for k, r in enumerate(radius_mm):
        if behind > throat:
            if r > radius_mm[behind]:
                behind = k
            elif r * (1 + LEAST_CHANGE) < radius_mm[behind]:
                out.append(Expansion(throat, behind))
                throat = behind = k
        elif r <= radius_mm[throat]:
            throat = behind = k
        elif r > radius_mm[throat] * (1 + LEAST_CHANGE):
            behind = k
    return (*out, Expansion(throat, behind)) if behind > throat else tuple(out)


def expansion_loss(throat_mm: Array, behind_mm: Array, density_kg_m3: float) -> Array:
    """Loss coefficient S of an expansion between two radii, Pa s^2 / m^6; 0 for a narrowing."""
    areas = [np.pi * (np.asarray(r) * _MM) ** 2 for r in (throat_mm, behind_mm)]
    step = np.maximum(1.0 / areas[0] - 1.0 / areas[1], 0.0)
    out: Array = 0.5 * EXPANSION_LOSS * density_kg_m3 * step**2
    return out
