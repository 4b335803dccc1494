"""What is filled with contrast in a generated angiogram: the tree, its twigs, the catheter."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from scipy import ndimage

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.types import Array, Image, Mask
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.trees import SyntheticTree, random_tree

#: a catheter's outer diameter (4 to 9 F), mm; what it absorbs as a share of a vessel as wide; and
#: how many show their walls more than their lumen
CATHETER_MM = (1.3, 3.0)
CATHETER_SHARE = (0.35, 1.0)
HOLLOW = 0.2
#: twigs wider than this are drawn by experts, thinner ones by some, pixels
DRAWN_PX = 2.5
#: long even branches at most, which look like wires and are none
LONG_BRANCHES = 3


@dataclasses.dataclass(frozen=True, eq=False)
class Vessels:
    """Chords through contrast, in pixel edges.

    Attributes
    ----------
    path_px : (side, side) float32, through coronary vessels
    doubtful : (side, side) bool, twigs that some draw and some do not
    ostium : (col, row) where the tree begins
    heading : (2,) unit vector, (col, row), of the first vessel there
    """

    path_px: Image
    doubtful: Mask
    ostium: Array
    heading: Array


def random_vessels(rng: np.random.Generator, side: int, pixel_mm: float) -> Vessels:
    """Draw one tree from a random direction, at times only a part of it, and wriggle it."""
    tree = random_tree(rng).sides("left" if rng.random() < 0.65 else "right")
    carm = _view(rng, tree, side, pixel_mm)
    path = _filled(rng, tree, carm) / np.float32(pixel_mm)
    start = carm.project(tree.vessels[0].points_mm[:6])[0]
    twigs, thin = _twigs(rng, path)
    path = np.maximum(path, twigs)
    if rng.random() < 0.5:
        path = np.maximum(path, _long_branches(rng, path))
    wave = _wave(rng, side)
    bent = cv2.remap(path, *wave, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    doubtful = cv2.remap(thin, *wave, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    step = start[-1] - start[0]
    return Vessels(
        path_px=np.asarray(bent),
        doubtful=doubtful > 0.1,
        ostium=start[0],
        heading=step / max(float(np.hypot(*step)), 1e-9),
    )


def _view(rng: np.random.Generator, tree: SyntheticTree, side: int, pixel_mm: float) -> CArm:
    sod, sdd = rng.uniform(700, 820), rng.uniform(950, 1200)
    spacing = float(pixel_mm * sdd / sod)
    carm = CArm(
        primary_angle_deg=float(rng.uniform(-60, 60)),
        secondary_angle_deg=float(rng.uniform(-35, 35)),
        sod_mm=float(sod), sdd_mm=float(sdd), rows=side, columns=side,
        pixel_spacing_mm=(spacing, spacing),
    )  # fmt: skip
    # The operator follows the vessels: the middle of the picture is near some of them.
    points = carm.project(np.concatenate([v.points_mm for v in tree.vessels]))[0]
    aim = 0.5 * (points.mean(axis=0) + points[rng.integers(len(points))])
    middle = (side - 1) - aim + rng.uniform(-0.15, 0.15, 2) * side
    return dataclasses.replace(carm, principal_point_px=(float(middle[0]), float(middle[1])))


def _filled(rng: np.random.Generator, tree: SyntheticTree, carm: CArm) -> Image:
    """Path lengths, mm, with contrast thinning out branch by branch."""
    swell = rng.uniform(0.75, 1.4)
    path = np.zeros((carm.rows, carm.columns), np.float32)
    groups: dict[float, list[int]] = {}
    for k in range(len(tree.vessels)):
        strength = 1.0 if k == 0 else float(rng.choice([1.0, 1.0, 1.0, 0.8, 0.6]))
        groups.setdefault(strength, []).append(k)
    for strength, members in groups.items():
        part = dataclasses.replace(tree, vessels=tuple(tree.vessels[k] for k in members))
        starts, ends, radii = part.segments()
        path = np.maximum(path, strength * path_lengths(carm, starts, ends, swell * radii))
    return path


def _twigs(rng: np.random.Generator, path: Image) -> tuple[Image, Image]:
    """Side branches that the generator's trees lack: chords, and which are too thin to be sure."""
    side = path.shape[0]
    chords, thin = np.zeros_like(path), np.zeros_like(path)
    rows, cols = np.nonzero(path > 1.5)
    if len(rows) == 0:
        return chords, thin
    for _ in range(int(rng.integers(0, 22))):
        k = rng.integers(len(rows))
        width = min(float(rng.uniform(0.8, 4.0)), 0.8 * float(path[rows[k], cols[k]]))
        line = _walk(rng, np.array([cols[k], rows[k]], float), int(rng.uniform(15, 0.45 * side)))
        ribbon(chords, line, width, float(rng.uniform(0.4, 0.9)) * width)
        if width < DRAWN_PX:
            ribbon(thin, line, width + 1.5, 1.0)
    return chords, thin


def _long_branches(rng: np.random.Generator, path: Image) -> Image:
    """Vessels that run on, hardly thinner and hardly bent, to where the picture ends."""
    side = path.shape[0]
    chords = np.zeros_like(path)
    rows, cols = np.nonzero(path > 2.0)
    if len(rows) == 0:
        return chords
    for _ in range(int(rng.integers(0, LONG_BRANCHES + 1))):
        k = rng.integers(len(rows))
        width = min(float(rng.uniform(2.0, 7.0)), 0.9 * float(path[rows[k], cols[k]]))
        length = int(rng.uniform(0.3, 0.9) * side)
        bend = ndimage.gaussian_filter1d(rng.standard_normal(length), 25, mode="nearest")
        angle = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.uniform(0.02, 0.15) * bend)
        steps = np.stack([np.cos(angle), np.sin(angle)], 1)
        line = np.array([cols[k], rows[k]], float) + np.cumsum(steps, axis=0)
        depth = float(rng.uniform(0.5, 1.0))
        parts = np.array_split(line, 5)
        for n, part in enumerate(parts):  # thinning towards the end
            now = width * (1 - float(rng.uniform(0.05, 0.12)) * n)
            joined = part if n == 0 else np.concatenate([parts[n - 1][-1:], part])
            ribbon(chords, joined, now, depth * now)
    return chords


def _walk(rng: np.random.Generator, start: Array, steps: int) -> Array:
    """(n, 2) points one pixel apart, heading drifting and wriggling."""
    s = np.arange(steps)
    drift = ndimage.gaussian_filter1d(rng.standard_normal(steps), 12, mode="nearest")
    wriggle = rng.uniform(0, 0.8) * np.sin(2 * np.pi * (s / rng.uniform(14, 45) + rng.uniform()))
    angle = rng.uniform(0, 2 * np.pi) + np.cumsum(0.18 * drift) + wriggle
    return start + np.cumsum(np.stack([np.cos(angle), np.sin(angle)], 1), axis=0)


def _wave(rng: np.random.Generator, side: int) -> tuple[Image, Image]:
    """Return maps (col, row) of a smooth displacement: real vessels wriggle with the wall."""
    row, col = np.indices((side, side), dtype=np.float32)
    maps = []
    for base in (col, row):
        scale = rng.uniform(9, 28)
        noise = ndimage.gaussian_filter(rng.standard_normal((side, side)), scale, mode="nearest")
        maps.append((base + rng.uniform(0, 0.22) * scale * noise / noise.std()).astype(np.float32))
    return maps[0], maps[1]


def ribbon(out: Image, line: Array, width_px: float, top: float) -> None:
    """Draw a round tube's chords along (n, 2) points (col, row) into ``out``: the larger wins.

    Four strokes of falling width stand for sqrt(1 - x^2).
    """
    points = np.rint(np.asarray(line) * 16).astype(np.int32)
    scale = 4  # widths are whole pixels: draw them finer
    size = (scale * out.shape[1], scale * out.shape[0])
    low, high = points.min(axis=0) // 16 - 4, points.max(axis=0) // 16 + 5
    reach = int(np.ceil(width_px)) + 2
    c0, r0 = np.maximum(low - reach, 0)
    c1, r1 = np.minimum(high + reach, [size[0] // scale, size[1] // scale])
    if c0 >= c1 or r0 >= r1:
        return
    canvas = np.zeros((scale * (r1 - r0), scale * (c1 - c0)), np.float32)
    moved = (points - 16 * np.array([c0, r0])) * scale
    for share in (1.0, 0.85, 0.6, 0.3):
        height = top * np.sqrt(1 - (share - 0.15) ** 2)
        wide = max(1, round(scale * width_px * share))
        cv2.polylines(canvas, [moved], False, float(height), wide, cv2.LINE_8, 4)
    small = cv2.resize(canvas, (c1 - c0, r1 - r0), interpolation=cv2.INTER_AREA)
    part = out[r0:r1, c0:c1]
    np.maximum(part, small, out=part)


def catheter(rng: np.random.Generator, vessels: Vessels, pixel_mm: float) -> tuple[Image, Image]:
    """Draw what brings the contrast, from a border to the ostium, and what is spilled there.

    The tip lies in the ostium along the vessel; the shaft bends once or twice on its way.

    Returns
    -------
    tube, spill : (side, side) float32, chords in pixel edges
    """
    side = vessels.path_px.shape[0]
    out = np.zeros((side, side), np.float32)
    mm = 1.0 / pixel_mm
    tip = vessels.ostium + vessels.heading * rng.uniform(-1, 4) * mm
    back = -vessels.heading + rng.normal(0, 0.5, 2)
    first = tip + back / max(float(np.hypot(*back)), 1e-9) * rng.uniform(8, 35) * mm
    end = rng.uniform(-0.1, 1.1, 2) * side
    edge = rng.choice(4, p=[0.55, 0.15, 0.15, 0.15])  # above, below, left, right
    end[1 if edge < 2 else 0] = -10 if edge in (0, 2) else side + 10
    way = end - first
    sideways = np.array([-way[1], way[0]]) * rng.normal(0, 0.35)
    second = first + 0.5 * way + sideways
    line = _bezier(np.stack([tip, first, second, end]))
    width = rng.uniform(*CATHETER_MM) * mm
    ribbon(out, line, width, width * rng.uniform(*CATHETER_SHARE))
    if rng.random() < 0.15:  # a loop in the root, or a second catheter
        other = _bezier(np.stack([first, tip + rng.normal(0, 12, 2) * mm, end, end + 20]))
        ribbon(out, other, 0.9 * width, 0.9 * width * rng.uniform(*CATHETER_SHARE))
    if rng.random() < HOLLOW:  # empty: its walls are denser than its lumen
        lumen = np.zeros_like(out)
        ribbon(lumen, line, 0.7 * width, rng.uniform(0.3, 0.8))
        out *= 1 - lumen
    spill = np.zeros_like(out)
    if rng.random() < 0.35:
        spill = _spill(rng, side, tip + back * rng.uniform(0, 8) * mm, pixel_mm)
    return np.asarray(cv2.GaussianBlur(out, (0, 0), 0.6)), spill


def _bezier(corners: Array) -> Array:
    t = np.linspace(0, 1, 120)[:, None]
    a, b, c, d = corners
    return (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * b + 3 * (1 - t) * t**2 * c + t**3 * d


def _spill(rng: np.random.Generator, side: int, where: Array, pixel_mm: float) -> Image:
    """Contrast that flows back into the aortic root: a torn cloud, chords in pixel edges."""
    row, col = np.indices((side, side), dtype=np.float32)
    reach = rng.uniform(4, 14) / pixel_mm
    near = np.exp(-0.5 * ((col - where[0]) ** 2 + (row - where[1]) ** 2) / reach**2)
    torn = ndimage.gaussian_filter(rng.standard_normal((side, side)), rng.uniform(2, 6))
    cloud = near * np.clip(0.7 + 0.5 * torn / torn.std(), 0, None)
    return (rng.uniform(0.5, 4) / pixel_mm * cloud).astype(np.float32)
