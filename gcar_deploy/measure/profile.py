"""Profile of a vessel across its axis: an elliptical lumen seen through the system's blur.

A lumen of half-width a across the ray and half-depth c a along it adds the path

    p(x) = c a g((x - x0) / a, s / a),   g(u, s) = 2 sqrt(1 - u^2) convolved with N(0, s^2),

s the standard deviation of all blur together (focal spot, detector, motion, pixel). Its area is
pi c a^2 whatever the blur: edges behind a known blur fix a, densitometry fixes c a^2. ``g`` and its
derivatives are read off a table: there is no closed form.
"""

from __future__ import annotations

import dataclasses
import functools

import cv2
import numpy as np

from gcar_deploy.types import Array, Scalars

#: unknowns of a profile: middle, log half-width, log depth over width, background and its slope
MIDDLE, HALF, DEPTH, GROUND, SLOPE = range(5)
#: blur over half-width, in the table as s / (1 + s); below the first it is a sharp edge
_BLURS = np.linspace(0.04, 0.86, 83)
#: distance over the spread of the blurred chord
_REACH, _STEPS = 4.5, 180
#: residuals beyond so many deviations lose weight (Cauchy)
_ROBUST = 3.0
#: ... and what the lumen's own shape may leave, as a share of its height, step by step
_SLACK = (1.0, 0.5, 0.25, 0.1, 0.05, 0.03)
_DAMPING, _MOST_LOG, _LEAST_HALF_MM = 1e-6, 0.4, 0.08


@dataclasses.dataclass(frozen=True, eq=False)
class Profiles:
    """Samples across a vessel, n profiles of m samples each.

    Attributes
    ----------
    x_mm : (n, m) distance from the axis, mm at the vessel
    signal : (n, m) what the picture shows there
    weight : (n, m) independent pixels that a sample stands for; 0 where it says nothing
    """

    x_mm: Array
    signal: Array
    weight: Array

    def __getitem__(self, rows: Array) -> Profiles:
        """Return the profiles of some rows."""
        return Profiles(self.x_mm[rows], self.signal[rows], self.weight[rows])


@dataclasses.dataclass(frozen=True, eq=False)
class Belief:
    """What is known of the unknowns beforehand: (n, 5) means and (5,) standard deviations."""

    mean: Array
    sd: Scalars


@dataclasses.dataclass(frozen=True, eq=False)
class Fitted:
    """Profiles fitted.

    Attributes
    ----------
    values : (n, 5) unknowns
    covariance : (n, 5, 5) of them, for noise of 1
    residual : (n, m) signal minus model
    """

    values: Array
    covariance: Array
    residual: Array


def blurred_chord(
    x_mm: Array, half_mm: Scalars, blur_mm: float | Scalars
) -> tuple[Array, Array, Array]:
    """Chord of a lumen as deep as wide, over its half-width; and derivatives.

    Parameters
    ----------
    x_mm : (n, m) distance from the middle
    half_mm : (n,) half-width a
    blur_mm : standard deviation of the blur, of all or (n,)

    Returns
    -------
    (n, m) each: g, its derivative by x / a, and that of a g by a
    """
    ratio = (blur_mm / half_mm)[:, None]
    u = x_mm / half_mm[:, None]
    spread = np.sqrt(0.25 + ratio**2)
    row = (ratio / (1 + ratio) - _BLURS[0]) / (_BLURS[1] - _BLURS[0])
    column = np.minimum(np.abs(u) / spread * (_STEPS / _REACH), _STEPS)
    rows = np.broadcast_to(np.clip(row, 0, len(_BLURS) - 1), u.shape).astype(np.float32)
    # Places between the table's own are rounded to a 32nd, which is far below the noise.
    found = cv2.remap(_table(), column.astype(np.float32), rows, cv2.INTER_LINEAR,
                      borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    return found[:, :, 0], found[:, :, 1] * np.sign(u), found[:, :, 2]


@functools.cache
def _table() -> Array:
    """(blurs, steps + 1, 3) g, dg/du and d(a g)/da, by convolution on a fine line."""
    du = 0.005
    out = np.empty((len(_BLURS), _STEPS + 1, 3))
    for k, blur in enumerate(_BLURS / (1 - _BLURS)):
        half = _REACH * np.sqrt(0.25 + blur**2) * 1.02
        step = max(du, half / 2000)
        u = np.arange(-np.ceil(half / step) - 2, np.ceil(half / step) + 3) * step
        # The integral of the chord is smooth where the chord itself has an edge.
        edges = np.clip(np.append(u - step / 2, u[-1] + step / 2), -1, 1)
        whole = edges * np.sqrt(1 - edges**2) + np.arcsin(edges)
        # A power of two, which the transform likes best, and room for what the blur spreads.
        size = 1 << (2 * len(u) - 1).bit_length()
        frequency = np.fft.rfftfreq(size, step)
        smooth = np.exp(-2 * (np.pi * blur * frequency) ** 2)
        chord = np.fft.irfft(np.fft.rfft(np.diff(whole) / step, size) * smooth, size)
        g = chord[: len(u)]
        slope = np.gradient(g, step)
        # Heat equation: blur^2 d/d(blur^2) g = blur^2 g'' / 2.
        growth = g - u * slope - blur**2 * np.gradient(slope, step)
        at = np.linspace(0, _REACH, _STEPS + 1) * np.sqrt(0.25 + blur**2)
        for j, column in enumerate((g, slope, growth)):
            out[k, :, j] = np.interp(at, u, column)
    return out.astype(np.float32)


def fit_profiles(
    seen: Profiles,
    stretch: Scalars,
    blur_mm: float | Scalars,
    belief: Belief,
    noise: float,
) -> Fitted:
    """Fit profiles by Gauss-Newton steps from what is believed.

    Parameters
    ----------
    seen : Profiles
    stretch : (n,) path over depth across the vessel: one over the sine between vessel and ray
    blur_mm : standard deviation of the blur, of all or (n,)
    belief : Belief
    noise : of the signal, standard deviation of a pixel
    """
    values, centre = belief.mean.copy(), 0.5 * np.ptp(seen.x_mm, axis=1)
    precision = 1.0 / belief.sd**2
    for step in range(len(_SLACK)):
        half = np.exp(values[:, HALF])
        x = seen.x_mm - values[:, MIDDLE, None]
        g, slope, growth = blurred_chord(x, half, blur_mm)
        scale = (np.exp(values[:, DEPTH]) * stretch)[:, None]
        lean = seen.x_mm / centre[:, None]
        model = scale * half[:, None] * g
        residual = seen.signal - model - values[:, GROUND, None] - values[:, SLOPE, None] * lean
        # By middle, log half-width, log depth over width, background, slope.
        J = np.stack(
            [-scale * slope, scale * half[:, None] * growth, model, np.ones_like(g), lean], axis=2
        )
        # Far from the answer all residuals are large: they count in full at first.
        slack = _ROBUST * noise + _SLACK[step] * 2 * half[:, None] * scale
        w = seen.weight / noise**2 / (1 + (residual / slack) ** 2)
        weighted = J * w[:, :, None]
        H = np.swapaxes(weighted, 1, 2) @ J
        index = np.arange(5)
        H[:, index, index] = H[:, index, index] * (1 + _DAMPING) + precision
        if step == len(_SLACK) - 1:
            break
        pull = np.einsum("nmk,nm->nk", weighted, residual) + precision * (belief.mean - values)
        change = np.linalg.solve(H, pull[:, :, None])[:, :, 0]
        change[:, HALF:GROUND] = np.clip(change[:, HALF:GROUND], -_MOST_LOG, _MOST_LOG)
        values = values + change
        values[:, HALF] = np.maximum(values[:, HALF], np.log(_LEAST_HALF_MM))
    return Fitted(values=values, covariance=np.linalg.inv(H), residual=residual)
