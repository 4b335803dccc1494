"""Generated angiograms with their truth: trees of the generator over what else is in a picture.

Vessels and catheter (``angiogram_vessels``) over soft anatomy, spine, ribs, diaphragm, wires, or
what a subtraction leaves of them, behind quanta, collimator and display (``angiogram_scenery``).
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from gcar_deploy.imaging import enhance
from gcar_deploy.imaging.net import net_input
from gcar_deploy.types import Array, Image, Mask
from gcar_export.scenes.angiogram_scenery import displayed, exposed, moved, scenery
from gcar_export.scenes.angiogram_vessels import catheter, random_vessels

#: pixels along each side; chords that are vessel for sure, and those that may be, pixel edges
SIDE = 256
SURE_PX, PERHAPS_PX = 0.8, 0.25
#: attenuation that is too little to be drawn by anyone
FAINT = 0.015
#: wires and leads in a picture on average, and how many pictures show a catheter; fewer where the
#: network is not to lose a vessel to a look-alike, and what a pixel of a device then counts
WIRES, CATHETERS = 0.35, 0.75
LENIENT_WIRES, LENIENT_CATHETERS, LENIENT_WEIGHT = 0.1, 0.6, 0.2
#: attenuation from which a pixel is one of a device
DEVICE = 0.01


@dataclasses.dataclass(frozen=True, eq=False)
class GeneratedAngiogram:
    """One picture with its truth.

    Attributes
    ----------
    pixels : (SIDE, SIDE) uint8, vessels dark
    mask : (SIDE, SIDE) bool, coronary vessels alone
    unsure : (SIDE, SIDE) bool, rims, twigs and faint vessels that an expert may draw or leave out
    device : (SIDE, SIDE) bool, catheter, wires, leads, spilled contrast outside vessels
    path_px : (SIDE, SIDE) float32, chords through vessels, in pixel edges at the isocentre
    pixel_mm, told_mm : float, at the isocentre: true, and as the runtime would think
    """

    pixels: Array
    mask: Mask
    unsure: Mask
    device: Mask
    path_px: Image
    pixel_mm: float
    told_mm: float


def generated_angiogram(seed: int, index: int, lenient: bool = False) -> GeneratedAngiogram:
    """Picture ``index`` of a stream; the same for the same arguments.

    ``lenient``: with fewer devices and more vessels that look like one.
    """
    rng = np.random.default_rng([seed, index])
    # Vessels have a known size only as far as the field is known: often it is not.
    told_mm = float(rng.uniform(0.48, 0.62))
    pixel_mm = told_mm / float(np.exp(rng.uniform(np.log(0.9), np.log(2.4))))
    vessels = random_vessels(rng, SIDE, pixel_mm, lenient)
    path_px = moved(rng, vessels.path_px)
    tube = np.zeros_like(path_px)
    if rng.random() < (LENIENT_CATHETERS if lenient else CATHETERS):
        tube = catheter(rng, vessels, pixel_mm)
    filled = np.maximum(path_px, tube)
    contrast = float(np.exp(rng.uniform(np.log(0.025), np.log(0.16))))
    patient, devices = scenery(rng, SIDE, pixel_mm, LENIENT_WIRES if lenient else WIRES)
    absorbed: Array = (
        contrast * pixel_mm * filled + cv2.GaussianBlur(patient, (0, 0), 0.7) + devices
    )
    pixels, field = exposed(rng, absorbed)
    seen = contrast * pixel_mm * path_px > FAINT
    mask = (path_px > SURE_PX) & ~vessels.doubtful & seen
    return GeneratedAngiogram(
        pixels=displayed(rng, pixels, field),
        mask=mask & field,
        unsure=(path_px > PERHAPS_PX) & ~mask & field,
        device=((contrast * pixel_mm * tube > DEVICE) | (devices > DEVICE))
        & (path_px <= PERHAPS_PX),
        path_px=np.where(field, path_px, np.float32(0)),
        pixel_mm=pixel_mm,
        told_mm=told_mm,
    )


def training_pair(seed: int, index: int, lenient: bool = False) -> tuple[Array, Array]:
    """Return the network's input and truth of a picture, flipped at random.

    The input is made by the code that makes it at run time, collimator search included.

    Returns
    -------
    channels : (CHANNELS, SIDE, SIDE) float32
    truth : (3, SIDE, SIDE) float32: vessel, weight of a pixel for that question, chord in pixel
        edges
    """
    made = generated_angiogram(seed, index, lenient)
    pixels = made.pixels.astype(np.float32)
    holes = enhance.collimator(pixels)
    white = max(float(np.percentile(pixels, 99.5)), 1e-12)
    picture = enhance.absorbance(pixels / np.float32(white))
    channels = net_input(picture, holes, made.told_mm)
    weight = np.where(made.unsure, 0.0, 1.0)
    if lenient:
        weight[made.device] = LENIENT_WEIGHT
    truth = np.stack([made.mask, weight, made.path_px]).astype(np.float32)
    truth[:, holes] = 0.0
    turn = np.random.default_rng([seed, index, 2]).integers(0, 2, 3)
    for axis in range(2):
        if turn[axis]:
            channels, truth = np.flip(channels, axis + 1), np.flip(truth, axis + 1)
    if turn[2]:
        channels, truth = channels.transpose(0, 2, 1), truth.transpose(0, 2, 1)
    return np.ascontiguousarray(channels), np.ascontiguousarray(truth)


def picture_with_mask(made: GeneratedAngiogram) -> Array:
    """(SIDE, 2 SIDE, 3) uint8: the picture, and beside it the truth in green."""
    grey = cv2.cvtColor(made.pixels, cv2.COLOR_GRAY2BGR)
    drawn = grey.copy()
    drawn[made.mask] = (0.5 * drawn[made.mask] + np.array([0, 100, 0])).astype(np.uint8)
    drawn[made.unsure] = (0.7 * drawn[made.unsure] + np.array([70, 70, 0])).astype(np.uint8)
    return np.concatenate([grey, drawn], axis=1)
