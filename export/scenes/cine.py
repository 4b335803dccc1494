"""Generated cine runs: a beating tree filled with contrast, from two views one after the other."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from scipy import ndimage

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.types import Array, Image
from gcar_export.scenes.angiogram_scenery import scenery
from gcar_export.scenes.angiogram_vessels import Vessels, catheter
from gcar_export.scenes.angiograms import DEVICE, PERHAPS_PX
from gcar_export.scenes.beating import Heartbeat, RunMotion, random_heartbeat, random_run
from gcar_export.scenes.gantry import clinical_views
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.trees import (
    SIDES,
    SyntheticTree,
    random_tree,
    rough_style,
    thin_style,
)

#: pixels along each side, and their size at the isocentre, mm
SIDE, PIXEL_MM = 320, (0.36, 0.46)
FRAMES, BEATS = 15, 2.0
#: patient or table between the runs, standard deviation along each axis, mm
TABLE_MM = 3.0
#: steps of contrast that vessels are drawn in
_STEPS = 5


@dataclasses.dataclass(frozen=True, eq=False)
class CineRun:
    """One run.

    Attributes
    ----------
    carm : CArm as it is told; the patient moved by ``motion.shift_mm``, which nobody tells
    motion : RunMotion
    path_mm : (n, SIDE, SIDE) float32, chords through lumen times its share of contrast
    pixels : (n, SIDE, SIDE) uint8, vessels dark
    device : (n, SIDE, SIDE) bool, catheter, leads, wires and clips beside vessels
    """

    carm: CArm
    motion: RunMotion
    path_mm: Array
    pixels: Array
    device: Array


@dataclasses.dataclass(frozen=True, eq=False)
class CinePair:
    """One patient seen by two runs.

    Attributes
    ----------
    tree : SyntheticTree at the R wave
    beat : Heartbeat
    runs : two CineRun
    """

    tree: SyntheticTree
    beat: Heartbeat
    runs: tuple[CineRun, CineRun]

    def phase_error(self) -> Array:
        """(n, m) difference of phase of every pair of frames, beats, 0 .. 0.5."""
        a, b = (run.motion.phases for run in self.runs)
        apart = np.abs(a[:, None] - b[None]) % 1.0
        return np.minimum(apart, 1.0 - apart)

    def frames_per_beat(self) -> float:
        """Of the run that has more of them."""
        return max(float(1.0 / np.diff(run.motion.phases).mean()) for run in self.runs)

    def shape_error_mm(self) -> Array:
        """(n, m) root mean square distance of the tree's points, less a shift of the whole."""
        points = np.concatenate([v.points_mm[::3] for v in self.tree.vessels])
        a, b = (
            np.stack([self.beat.at(points, phase) for phase in run.motion.phases])
            for run in self.runs
        )
        a, b = (x - x.mean(axis=1, keepdims=True) for x in (a, b))
        squares = ((a[:, None] - b[None]) ** 2).sum(axis=3)
        return np.sqrt(squares.mean(axis=2))


def cine_pair(seed: int, number: int, frames: int = FRAMES, wait: float = 0.0) -> CinePair:
    """Patient ``number`` of a population; the same for the same arguments.

    ``wait``: frames by which contrast comes later, see ``random_run``.
    """
    rng = np.random.default_rng([seed, number])
    style = (None, rough_style(rng), thin_style(rng))[rng.choice(3, p=[0.45, 0.4, 0.15])]
    tree = random_tree(rng, style).sides(SIDES[number % 2])
    beat = random_heartbeat(rng, tree)
    runs = tuple(
        _run(rng, tree, beat, carm, random_run(rng, frames, BEATS, table, wait))
        for carm, table in zip(_views(rng, tree), (0.0, TABLE_MM), strict=True)
    )
    return CinePair(tree, beat, (runs[0], runs[1]))


def _views(rng: np.random.Generator, tree: SyntheticTree) -> list[CArm]:
    """Two clinical views; the operator has the tree in the picture, or nearly so."""
    out = []
    for carm in clinical_views(rng, 2, float(rng.uniform(*PIXEL_MM))):
        carm = dataclasses.replace(carm, rows=SIDE, columns=SIDE, principal_point_px=None)
        points = carm.project(np.concatenate([v.points_mm for v in tree.vessels]))[0]
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0)) + rng.uniform(-15, 15, 2)
        at = (SIDE - 1) - middle
        out.append(dataclasses.replace(carm, principal_point_px=(float(at[0]), float(at[1]))))
    return out


def _run(
    rng: np.random.Generator, tree: SyntheticTree, beat: Heartbeat, carm: CArm, motion: RunMotion
) -> CineRun:
    speed = rng.uniform(25, 80)  # mm of vessel that the front of the contrast takes in a frame
    out_at = rng.uniform(0.65, 1.3) * len(motion.phases)
    filled = [
        (phase, shift, _contrast(tree, speed * t, (t - out_at) / rng.uniform(2, 6)))
        for phase, shift, t in zip(motion.phases, motion.shift_mm, motion.bolus, strict=True)
    ]
    paths = np.stack([_drawn(tree, beat, carm.moved(s), p, c) for p, s, c in filled])
    start = tree.vessels[0].points_mm[[0, 5]]
    ostium = np.stack([
        carm.moved(s).project(beat.at(start, p))[0]
        for p, s in zip(motion.phases, motion.shift_mm, strict=True)
    ])  # fmt: skip
    middle = carm.project(motion.shift_mm)[0]
    squeeze = beat.squeeze(motion.phases % 1.0)
    pixels, device = _exposed(rng, carm, paths, ostium, middle - middle[0], squeeze)
    return CineRun(carm, motion, paths, pixels, device)


def _contrast(tree: SyntheticTree, front_mm: float, late: float) -> list[Array]:
    """Share of contrast along each vessel: full behind the front, thinning out from the ostium."""
    ostium = tree.vessels[0].points_mm[0]
    shares = []
    for v in tree.vessels:
        way = 1.3 * np.linalg.norm(v.points_mm - ostium, axis=1)
        full = 1 / (1 + np.exp(np.clip((way - front_mm) / 8.0, -50, 50)))
        # Blood without contrast follows from the ostium on.
        gone = np.exp(-np.clip(late - way / 150.0, 0, None))
        shares.append(full * gone)
    return shares


def _drawn(
    tree: SyntheticTree, beat: Heartbeat, carm: CArm, phase: float, contrast: list[Array]
) -> Image:
    """(rows, columns) chords times contrast, mm."""
    starts, ends, radii, share = [], [], [], []
    for v, c in zip(tree.vessels, contrast, strict=True):
        points = beat.at(v.points_mm, phase)
        starts.append(points[:-1])
        ends.append(points[1:])
        radii.append(0.5 * (v.radius_mm[1:] + v.radius_mm[:-1]))
        share.append(np.rint(_STEPS * 0.5 * (c[1:] + c[:-1])))
    step = np.concatenate(share)
    parts = [np.concatenate(x) for x in (starts, ends, radii)]
    out = np.zeros((carm.rows, carm.columns), np.float32)
    for k in range(1, _STEPS + 1):
        mine = step == k
        if mine.any():
            one = path_lengths(carm, *(x[mine] for x in parts))
            out += np.float32(k / _STEPS) * one
    return out


def _exposed(
    rng: np.random.Generator, carm: CArm, paths: Array, ostium: Array, shift_px: Array,
    squeeze: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """One patient, one machine, one display, new quanta in each frame; and where devices are.

    Parameters
    ----------
    paths : (n, rows, columns) mm
    ostium : (n, 2, 2) first points of the tree in each frame, (col, row)
    shift_px : (n, 2) how far the patient is from where he was in the first frame, (col, row)
    squeeze : (n,) contraction of the heart

    Returns
    -------
    pixels : (n, rows, columns) uint8
    device : (n, rows, columns) bool, of catheter, leads, wires and clips, beside vessels
    """
    pixel_mm = carm.pixel_at_isocenter_mm
    patient, devices = scenery(rng, SIDE, pixel_mm)
    step = ostium[0, 1] - ostium[0, 0]
    seen = Vessels(
        path_px=paths.max(axis=0) / np.float32(pixel_mm),
        doubtful=np.zeros((SIDE, SIDE), bool),
        ostium=ostium[0, 0],
        heading=step / max(float(np.hypot(*step)), 1e-9),
    )
    tube = np.zeros((SIDE, SIDE), np.float32)
    if rng.random() < 0.8:
        tube = catheter(rng, seen, pixel_mm)[0].astype(np.float32) * np.float32(pixel_mm)
    patient = cv2.GaussianBlur(patient, (0, 0), 0.7) + devices
    per_mm = float(np.exp(rng.uniform(np.log(0.06), np.log(0.3))))
    quanta = float(np.exp(rng.uniform(np.log(150), np.log(8000))))
    blur, gamma = rng.uniform(0.4, 1.1), rng.uniform(0.5, 1.2)
    # Breathing moves what is behind the heart by more or less than the heart.
    along, heart = rng.uniform(0.3, 1.5), rng.uniform(0, 0.25) * _shadow(rng)
    light, shown_device = [], []
    for k, path in enumerate(paths):
        ground = _pulled(patient, along * shift_px[k])
        ground = ground + heart * (1 - squeeze[k])
        own = _pulled(tube, ostium[k, 0] - ostium[0, 0], ostium[0, 0])
        absorbed = per_mm * np.maximum(path, own) + ground
        lines = np.maximum(per_mm * own, _pulled(devices, along * shift_px[k]))
        shown_device.append((lines > DEVICE) & (path <= PERHAPS_PX * pixel_mm))
        light.append(ndimage.gaussian_filter(np.exp(-absorbed), blur))
    counts = rng.poisson(quanta * np.stack(light)) / quanta
    shown = np.stack([ndimage.gaussian_filter(one, 0.5) for one in counts]) ** gamma
    low, high = np.quantile(shown, [0.003, 0.995])
    grey = 10 + 235 * (shown - low) / max(float(high - low), 1e-9)
    return np.clip(grey, 0, 255).round().astype(np.uint8), np.stack(shown_device)


def _shadow(rng: np.random.Generator) -> Image:
    """(SIDE, SIDE) float32, 0 .. 1: the heart's wall that thickens and thins, a soft blob."""
    row, col = np.indices((SIDE, SIDE), dtype=np.float32) / SIDE
    a, b = rng.uniform(0.25, 0.75, 2)
    reach = np.hypot((col - a) / rng.uniform(0.15, 0.4), (row - b) / rng.uniform(0.15, 0.4))
    soft: Image = (1 / (1 + np.exp((reach - 1) / 0.08))).astype(np.float32)
    return soft


def _pulled(picture: Image, way_px: Array, near: Array | None = None) -> Image:
    """Return a picture moved by ``way_px`` (col, row), or only ``near`` a point of it."""
    row, col = np.indices(picture.shape, dtype=np.float32)
    share: Array = np.ones(())
    if near is not None:
        far = ((col - near[0]) ** 2 + (row - near[1]) ** 2) / np.float32((0.2 * SIDE) ** 2)
        share = np.exp(-0.5 * far)
    moved = cv2.remap(
        picture.astype(np.float32),
        np.asarray(col - share * way_px[0], dtype=np.float32),
        np.asarray(row - share * way_px[1], dtype=np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT,
    )
    return np.asarray(moved)
