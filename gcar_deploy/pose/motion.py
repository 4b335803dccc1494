"""Smooth motion of the heart between two runs, beyond a shift: what two exact views tell of it.

Cardiac phase and breathing deform the tree by millimetres. Two views see of that what lies across
their epipolar planes: there the vessel mass of each plane must agree (``geometry/consistency``).
It is estimated together with the pose as a smooth field over the second picture: a Gaussian
process with a squared-exponential kernel (Rasmussen and Williams, Gaussian Processes for Machine
Learning, 2006, section 4.2), of which the leading Karhunen-Loeve modes over the picture's vessels
are the unknowns, each standard normal beforehand. What lies within the planes leaves no trace: it
moves the tree along the beams.

Only calibrated pictures are asked: the profiles of exact paths agree to a part in a thousand,
those of masks and raw pictures to a tenth, which is as much as millimetres of motion do.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import scipy  # its optimize is imported where it is first used: most runs never need it

from gcar_deploy.config import PoseOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.consistency import Mass, disagreement, mass_profiles
from gcar_deploy.geometry.epipolar import plane_normal
from gcar_deploy.geometry.prior import ANGLE_DEG, OFFSET_MM
from gcar_deploy.imaging import skeleton as skel
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.pose.joint import corrected
from gcar_deploy.pose.profile_fit import FREE, PROFILE_NOISE, SEARCH_MM, STEP_MM, pair_theta
from gcar_deploy.types import Array, Image, Mask, Pixels, Scalars

#: how far a point moves beyond a shift and over what distance alike, standard deviation and
#: length scale of the kernel, mm
MOTION_MM, ALIKE_MM = 2.0, 50.0
#: modes that are estimated, and pixels that they are worked out from
MODES, NODES = 16, 300
#: views that disagree by no more than this once they are placed have not moved, 0 .. 1; coarse
#: pixels alone make so much of it per mm (``still``)
STILL, STILL_PER_MM = 0.01, 0.03
#: motion is believed where it lowers the disagreement to this share, and to no more than this, and
#: where its root mean square is no more than two standard deviations. Of vessels that are strained
#: as well the mass per plane changes by some hundredths, which no field over the picture mends
LEAST_GAIN, MOST_LEFT, MOST_MM = 0.5, 0.04, 2 * MOTION_MM
#: error of a profile in the last fits, as shares of ``PROFILE_NOISE``: exact profiles agree far
#: better, once the motion is nearly found; steps of each fit, their end, and finite differences
NARROWING, MOST_STEPS, TOLERANCE, STEP_SHARE = (1.0, 0.2, 0.1), 15, 1e-3, 1e-2
#: digits of what is found that the pictures can tell
DIGITS = 4
#: inverse of the field by repeated insertion: moves of one pixel in a hundred are done in this many
_INSERTIONS = 6


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Displacement of a view's picture across the epipolar planes.

    Attributes
    ----------
    nodes_mm : (m, 2) places on the isocentre's plane, from the principal point (right, down), mm
    weights : (m,) of the kernel at each
    direction : (2,) unit vector (right, down) across the epipolar lines
    rms_mm : float, root mean square over the picture's vessels, the mean taken out
    """

    nodes_mm: Array
    weights: Scalars
    direction: Array
    rms_mm: float

    def at(self, carm: CArm, pixels: Pixels) -> Pixels:
        """(n, 2) pixels (col, row) that the motion, undone, adds to (n, 2) pixels of a picture.

        Parameters
        ----------
        carm : CArm of the picture, of any size; its pose does not matter
        pixels : (n, 2) (col, row)
        """
        size = pixel_size_mm(carm)
        places = (pixels - np.array(carm.principal_point)) * size
        out = np.empty(len(pixels))
        for start in range(0, len(pixels), 65536):  # the kernel of a whole picture would be large
            part = slice(start, start + 65536)
            out[part] = _kernel(places[part], self.nodes_mm) @ self.weights
        return out[:, None] * self.direction / size

    def turned(self, turns: int) -> Motion:
        """Return the motion of the picture turned anticlockwise by so many quarter turns."""
        out = self
        for _ in range(turns % 4):
            nodes, (right, down) = out.nodes_mm, out.direction
            out = dataclasses.replace(
                out, nodes_mm=np.stack([nodes[:, 1], -nodes[:, 0]], axis=1),
                direction=np.array([down, -right]),
            )  # fmt: skip
        return out

    def undone(self, view: VesselImage) -> VesselImage:
        """Return a view as it would show the heart where the other view shows it."""
        column, row = self._sources(view.carm)
        path = _resampled(view.path_mm, column, row)
        mask = _looked_up(view.mask, column, row) & (path > 0)
        response, catheter = view.vesselness, view.catheter
        return dataclasses.replace(
            view,
            others=(),
            kept=None,
            path_mm=path,
            mask=mask,
            skeleton=skel.skeletonize(mask),
            valid=_looked_up(view.valid, column, row),
            vesselness=None if response is None else _resampled(response, column, row),
            catheter=None if catheter is None else _looked_up(catheter, column, row),
        )

    def undone_picture(self, angiogram: Angiogram) -> Angiogram:
        """Return the picture as ``undone`` returns what was found in it."""
        column, row = self._sources(angiogram.carm)
        valid, mask, erased, painted = (
            None if array is None else _looked_up(array, column, row)
            for array in (angiogram.valid, angiogram.mask, angiogram.erased, angiogram.painted)
        )
        return dataclasses.replace(
            angiogram, pixels=_resampled(angiogram.pixels, column, row),
            valid=valid, mask=mask, erased=erased, painted=painted,
        )  # fmt: skip

    def _sources(self, carm: CArm) -> tuple[Array, Array]:
        """Two (rows, cols) float32: column and row that each pixel of the straightened has."""
        # Smooth over centimetres: a point every some pixels says it all.
        step = max(1, round(2.0 / carm.pixel_at_isocenter_mm))
        columns, rows = (
            np.arange(0, carm.columns + step, step),
            np.arange(0, carm.rows + step, step),
        )
        goal = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2).astype(np.float64)
        source = goal
        for _ in range(_INSERTIONS):
            source = goal - self.at(carm, source)
        coarse = (source - goal).reshape(len(rows), len(columns), 2).astype(np.float32)
        column, row = np.meshgrid(
            np.arange(carm.columns, dtype=np.float32), np.arange(carm.rows, dtype=np.float32)
        )
        dx, dy = (
            cv2.remap(np.ascontiguousarray(part), column / step, row / step, cv2.INTER_LINEAR)
            for part in (coarse[:, :, 0], coarse[:, :, 1])
        )
        return column + dx, row + dy


@dataclasses.dataclass(frozen=True, eq=False)
class Modes:
    """Leading modes of a smooth motion across the epipolar planes, each standard normal beforehand.

    Attributes
    ----------
    nodes_mm, direction : as of ``Motion``
    weights : (m, k) of the kernel at each node, of every mode
    """

    nodes_mm: Array
    weights: Array
    direction: Array

    @classmethod
    def of(cls, fixed: CArm, carm: CArm, pixels: Pixels) -> Modes:
        """Return those of a view beside ``fixed`` whose vessels are (n, 2) ``pixels``."""
        places = (pixels - np.array(carm.principal_point)) * pixel_size_mm(carm)
        nodes = thinned(places, NODES)
        values, vectors = np.linalg.eigh(_kernel(nodes, nodes))
        count = min(MODES, len(nodes))
        modes = MOTION_MM * vectors[:, -count:] / np.sqrt(np.maximum(values[-count:], 1e-9))
        normal = plane_normal(fixed, carm)
        direction = np.array([normal @ carm.axes[0], normal @ carm.axes[1]])
        return cls(nodes, modes, direction / np.linalg.norm(direction))

    @property
    def count(self) -> int:
        """How many modes."""
        return self.weights.shape[1]

    def at(self, carm: CArm, pixels: Pixels) -> Array:
        """(n, k) displacement of (n, 2) pixels by each mode, mm."""
        places = (pixels - np.array(carm.principal_point)) * pixel_size_mm(carm)
        out: Array = _kernel(places, self.nodes_mm) @ self.weights
        return out

    def motion(self, x: Scalars, rms_mm: float) -> Motion:
        """Return the motion with (k,) weights of the modes."""
        return Motion(
            nodes_mm=self.nodes_mm, weights=self.weights @ x, direction=self.direction,
            rms_mm=rms_mm,
        )  # fmt: skip


def still(pixel_mm: float) -> float:
    """Disagreement of two placed pictures, 0 .. 1, up to which nothing has moved."""
    return max(STILL, STILL_PER_MM * pixel_mm)


def estimate_motion(
    fixed: Mass, moving: Mass, theta: Array, options: PoseOptions
) -> tuple[Array, Motion, float] | None:
    """Estimate the pose of a view anew, together with the motion of what it shows.

    Parameters
    ----------
    fixed, moving : Mass of two calibrated views; that of ``fixed`` with its pose built in
    theta : (5,) correction of the moving view, as estimated without motion
    options : PoseOptions, smoothed as for pictures of these pixels

    Returns
    -------
    theta, motion, after : (5,) correction, Motion, and the disagreement that is left, 0 .. 1;
        None where the pictures tell of no motion
    """
    before = disagreement(fixed, moving, corrected(moving.carm, theta), options.fine_mm)
    if not (fixed.calibrated and moving.calibrated) or before <= STILL:
        return None
    carm = moving.carm
    field = Modes.of(fixed.carm, carm, moving.pixels)
    basis, count = field.at(carm, moving.pixels), field.count
    normal = plane_normal(fixed.carm, carm)
    along = field.direction / pixel_size_mm(carm)

    def moved(x: Array) -> tuple[Mass, CArm]:
        pixels = moving.pixels + (basis @ x[FREE:])[:, None] * along
        return dataclasses.replace(moving, pixels=pixels), corrected(carm, pair_theta(x, normal))

    def residuals(x: Array, sigma_mm: float, noise: float) -> Scalars:
        a, b = mass_profiles(fixed, *moved(x), sigma_mm)
        out: Scalars = np.append((a - b) / (noise * np.sqrt(float(a @ a))), x / prior)
        return out

    def slopes(x: Array, sigma_mm: float, noise: float) -> Array:
        here = residuals(x, sigma_mm, noise)
        ahead = [residuals(x + step, sigma_mm, noise) - here for step in np.diag(steps)]
        return np.stack(ahead, axis=1) / steps

    prior = np.concatenate([[OFFSET_MM, ANGLE_DEG, ANGLE_DEG], np.ones(count)])
    steps = STEP_SHARE * prior
    x = min(
        (np.append(shift, np.zeros(len(prior) - 1))
         for shift in np.arange(-SEARCH_MM, SEARCH_MM + 1e-9, STEP_MM)),
        key=lambda x: float(np.sum(residuals(x, 2 * options.coarse_mm, PROFILE_NOISE) ** 2)),
    )  # fmt: skip
    for sigma_mm, noise in (
        (2 * options.coarse_mm, PROFILE_NOISE), (options.coarse_mm, PROFILE_NOISE),
        *((options.fine_mm, share * PROFILE_NOISE) for share in NARROWING),
    ):  # fmt: skip
        x = scipy.optimize.least_squares(
            residuals, x, jac=slopes, args=(sigma_mm, noise), x_scale=prior,
            ftol=TOLERANCE, xtol=TOLERANCE, max_nfev=MOST_STEPS,
        ).x  # fmt: skip
    x = np.round(x, DIGITS)
    after = disagreement(fixed, *moved(x), options.fine_mm)
    rms_mm = float((basis @ x[FREE:]).std())
    if after > min(LEAST_GAIN * before, MOST_LEFT) or rms_mm > MOST_MM or abs(x[0]) > SEARCH_MM:
        return None
    return pair_theta(x, normal), field.motion(x[FREE:], rms_mm), after


def thinned(points: Array, most: int) -> Array:
    """Return at most so many of (n, k) points, evenly along their order."""
    return points[np.linspace(0, len(points) - 1, min(most, len(points))).astype(np.int64)]


def pixel_size_mm(carm: CArm) -> Array:
    """(2,) width and height of a pixel at the isocentre, mm."""
    size: Array = float(np.linalg.norm(carm.source_mm)) / np.array(carm.focal_px)
    return size


def _kernel(a: Array, b: Array) -> Array:
    squares = ((a[:, None, :] - b[None, :, :]) ** 2).sum(axis=2)
    out: Array = np.exp(-0.5 * squares / ALIKE_MM**2)
    return out


def _resampled(picture: Image, column: Array, row: Array) -> Image:
    out = cv2.remap(picture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(out, dtype=np.float32)


def _looked_up(mask: Mask, column: Array, row: Array) -> Mask:
    out: Mask = _resampled(mask.astype(np.float32), column, row) >= 0.5
    return out
