"""Raw-looking 8-bit X-ray pictures from path lengths: vessels dark on anatomy and noise."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gcar_deploy.types import Array, Image


@dataclasses.dataclass(frozen=True, kw_only=True)
class RawOptions:
    """What a raw picture is made of; lengths as shares of the picture's width.

    Attributes
    ----------
    contrast_per_mm : float
        Attenuation of the filled vessel, 1/mm.
    background : float
        Standard deviation of the soft anatomy's attenuation.
    spine, rib, diaphragm : float
        Attenuation each adds where it is.
    photons : float
        Detected quanta per pixel behind nothing; sets the noise.
    blur_px : float
        Focal spot and detector unsharpness, standard deviation, pixels of a 512 picture.
    gamma : float
        Exponent of the display curve.
    saturated : float
        Share of pixels cut off at each end of the grey scale.
    """

    contrast_per_mm: float = 0.10
    background: float = 0.14
    spine: float = 0.12
    rib: float = 0.04
    diaphragm: float = 0.3
    photons: float = 1500.0
    blur_px: float = 1.0
    gamma: float = 0.9
    saturated: float = 0.002


def random_options(rng: np.random.Generator) -> RawOptions:
    """Draw how a pair of pictures is taken and displayed."""

    def between(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    def about(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    return RawOptions(
        contrast_per_mm=about(0.05, 0.22), background=between(0.05, 0.25), spine=between(0, 0.25),
        rib=between(0, 0.1), diaphragm=between(0, 0.5), photons=about(300, 8000),
        blur_px=between(0.5, 1.6), gamma=between(0.5, 1.6), saturated=about(0.0003, 0.003),
    )  # fmt: skip


def raw_picture(
    path_mm: Image, rng: np.random.Generator, options: RawOptions | None = None
) -> NDArray[np.uint8]:
    """Simulate the display-processed picture of one view.

    Beer-Lambert through vessel and anatomy, blur, Poisson noise, a display curve and an
    8-bit window.

    Parameters
    ----------
    path_mm : (rows, columns) vessel path length, mm
    rng : source of the anatomy and the noise
    options : RawOptions

    Returns
    -------
    (rows, columns) uint8, vessels dark
    """
    options = options or RawOptions()
    attenuation = options.contrast_per_mm * path_mm + _anatomy(path_mm.shape, rng, options)
    intensity = np.exp(-attenuation)
    blur = options.blur_px * path_mm.shape[1] / 512
    intensity = ndimage.gaussian_filter(intensity, blur)
    counts = rng.poisson(options.photons * intensity).astype(np.float64)
    # The detector smears its quanta a little, too: noise is not white.
    display = ndimage.gaussian_filter(counts / options.photons, 0.6) ** options.gamma
    low, high = np.quantile(display, [options.saturated, 1 - options.saturated])
    return np.clip(255 * (display - low) / max(high - low, 1e-9), 0, 255).round().astype(np.uint8)


def _anatomy(shape: tuple[int, ...], rng: np.random.Generator, options: RawOptions) -> Array:
    rows, columns = shape
    soft = np.zeros(shape)
    for scale, weight in ((0.16, 1.0), (0.06, 0.7), (0.02, 0.3), (0.008, 0.1)):
        noise = ndimage.gaussian_filter(rng.standard_normal(shape), scale * columns, mode="wrap")
        soft += weight * noise / noise.std()
    soft *= options.background / soft.std()
    row, column = np.mgrid[0:rows, 0:columns]
    u, v = column / columns, row / rows
    return (
        soft
        + options.spine * _spine(u, v, rng)
        + options.rib * _ribs(u, v, rng)
        + options.diaphragm * _diaphragm(u, v, rng)
    )


def _spine(u: Array, v: Array, rng: np.random.Generator) -> Array:
    """Return vertebral bodies: a soft vertical band, waisted once per body."""
    middle, half = rng.uniform(0.15, 0.85), rng.uniform(0.06, 0.09)
    waist = half * (1 + 0.12 * np.cos(2 * np.pi * (v / 0.18 + rng.uniform())))
    return 1 / (1 + np.exp((np.abs(u - middle) - waist) / 0.015))


def _ribs(u: Array, v: Array, rng: np.random.Generator) -> Array:
    """Return a few slanting, slightly bent bands with denser rims."""
    out = np.zeros_like(u)
    slope, bend = rng.uniform(-0.7, 0.7), rng.uniform(-0.4, 0.4)
    for start in np.arange(-0.4, 1.4, 0.28) + rng.uniform(0, 0.28):
        off = (v - start - slope * u - bend * (u - 0.5) ** 2) / 0.035
        out += np.exp(-((np.abs(off) - 1) ** 2) / 0.15) + 0.4 * (np.abs(off) < 1)
    return out


def _diaphragm(u: Array, v: Array, rng: np.random.Generator) -> Array:
    """Return a dome from below with a sharp edge."""
    top, middle = rng.uniform(0.8, 0.92), rng.uniform(0.3, 0.7)
    edge = top + rng.uniform(0.15, 0.35) * (u - middle) ** 2
    return 1 / (1 + np.exp((edge - v) / 0.003))
