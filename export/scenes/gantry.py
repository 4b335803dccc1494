"""Where the views of generated scenes are taken from."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gcar_deploy.geometry.carm import CArm, separation_deg
from gcar_deploy.types import Points

#: (primary, secondary) of the paper's two views, and of those that are usual in practice
PAPER_VIEWS = ((0, 0), (90, 0))
USUAL_VIEWS = ((-30, -20), (45, 25), (-30, 25), (45, -25), (0, 35), (0, -30))
USUAL_SPREAD_DEG = 5.0
#: rays of two views meet at this angle at least, and at its supplement at most, degrees
LEAST_SEPARATION_DEG = 25.0
NET_PIXELS = 128
#: largest edge of a clinical picture, pixels; a wider field gets larger pixels
MAX_PIXELS = 520


@dataclasses.dataclass(frozen=True)
class Field:
    """A ball to be seen: middle (3,) mm LPS and radius, mm."""

    middle_mm: np.ndarray
    radius_mm: float


def paper_views(rng: np.random.Generator, n: int, h: float) -> list[CArm]:
    """Draw ``n`` views at equal steps of 180 / n degrees, 128 x 128 pixels of ``h`` mm."""
    start = rng.uniform(-180, 90) if rng.random() < 0.5 else 0.0
    step = 180.0 / n
    return [
        CArm(
            primary_angle_deg=_wrap(start + k * step),
            secondary_angle_deg=0.0,
            sod_mm=1000 * h,
            sdd_mm=1500 * h,
            rows=NET_PIXELS,
            columns=NET_PIXELS,
            pixel_spacing_mm=(1.5 * h,) * 2,
        )
        for k in range(n)
    ]


def clinical_views(
    rng: np.random.Generator, n: int, pixel_mm: float, anywhere: bool = False
) -> list[CArm]:
    """Draw ``n`` views with pixels of about ``pixel_mm`` at the isocentre, 25 .. 155 degrees apart.

    ``anywhere`` takes them from the whole sphere in place of where C-arms usually stand.
    """
    while True:
        carms = [_clinical_view(rng, pixel_mm, anywhere) for _ in range(n)]
        if all(
            LEAST_SEPARATION_DEG < separation_deg(a, b) < 180 - LEAST_SEPARATION_DEG
            for i, a in enumerate(carms)
            for b in carms[:i]
        ):
            return carms


def _clinical_view(rng: np.random.Generator, pixel_mm: float, anywhere: bool) -> CArm:
    sod = rng.uniform(700, 820)
    sdd = rng.uniform(900, 1220)
    pixel = pixel_mm * rng.uniform(0.9, 1.1)
    primary, secondary = (rng.uniform(-180, 180), rng.uniform(-75, 75)) if anywhere else (
        rng.uniform(-60, 60), rng.uniform(-35, 35)
    )  # fmt: skip
    return CArm(
        primary_angle_deg=primary,
        secondary_angle_deg=secondary,
        sod_mm=sod,
        sdd_mm=sdd,
        rows=NET_PIXELS,
        columns=NET_PIXELS,
        pixel_spacing_mm=(pixel * sdd / sod,) * 2,
    )


def focused(carm: CArm, field: Field) -> CArm:
    """Return the view with a detector just large enough for the field."""
    (middle,), (depth,) = carm.project(np.asarray(field.middle_mm, dtype=np.float64)[None])
    edge = int(2 * (field.radius_mm * max(carm.focal_px) / depth + 4))
    coarser = max(edge / MAX_PIXELS, 1.0)
    edge = int(edge / coarser)
    c0, r0 = carm.principal_point
    at = [
        (own - there) / coarser + 0.5 * (edge - 1)
        for own, there in zip((c0, r0), middle, strict=True)
    ]
    row_mm, column_mm = carm.pixel_spacing_mm
    return dataclasses.replace(
        carm,
        rows=edge,
        columns=edge,
        principal_point_px=(at[0], at[1]),
        pixel_spacing_mm=(row_mm * coarser, column_mm * coarser),
    )


def turned_to_usual(
    rng: np.random.Generator, carms: Sequence[CArm], views: Sequence[tuple[int, int]], spread: float
) -> list[CArm]:
    """Keep distances and sizes, take the directions from ``views``, give or take ``spread``."""
    out = []
    for carm, (primary, secondary) in zip(carms, views, strict=True):
        turn = rng.normal(size=2) * spread
        out.append(
            dataclasses.replace(
                carm, primary_angle_deg=primary + turn[0], secondary_angle_deg=secondary + turn[1]
            )
        )
    return out


def random_rotation(rng: np.random.Generator, largest_deg: float | None = None) -> Points:
    """(3, 3) rotation: uniform over all, or by at most ``largest_deg`` about a random axis."""
    if largest_deg is None:
        q = rng.normal(size=4)
    else:
        axis = rng.normal(size=3)
        half = 0.5 * np.deg2rad(rng.uniform(0, largest_deg))
        q = np.concatenate([[np.cos(half)], np.sin(half) * axis / np.linalg.norm(axis)])
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _wrap(angle: float) -> float:
    return (angle + 180.0) % 360.0 - 180.0
