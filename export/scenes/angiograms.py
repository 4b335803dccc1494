"""Generated angiograms with their truth: trees of the generator over what else is in a picture.

Vessels and catheter (``angiogram_vessels``) over soft anatomy, spine, ribs, diaphragm, wires, or
what a subtraction leaves of them, behind quanta, collimator and display (``angiogram_scenery``).
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from gcar_deploy.imaging import enhance
from gcar_deploy.imaging.collimator import collimator
from gcar_deploy.imaging.net import net_input
from gcar_deploy.imaging.skeleton import skeletonize
from gcar_deploy.types import Array, Image, Mask
from gcar_export.scenes.angiogram_scenery import displayed, exposed, moved, scenery
from gcar_export.scenes.angiogram_vessels import catheter, random_vessels

#: pixels along each side; chords that are vessel for sure, and those that may be, pixel edges
SIDE = 256
SURE_PX, PERHAPS_PX = 0.8, 0.25
#: attenuation that is too little to be drawn by anyone
FAINT = 0.02
#: pictures with nothing but vessels, of any contrast; of the others, how many show a catheter; and
#: how much a pixel of a device counts where vessels are asked for
PLAIN, CATHETERS, DEVICE_WEIGHT = 0.15, 0.65, 1.0
#: attenuation of the contrast agent, 1/mm: hardly seen to saturated
CONTRAST = (0.03, 0.5)
#: size of a pixel, mm: fields of 80 to 240 mm at the size that the network looks at
PIXEL_MM = (0.22, 0.7)
#: grey values by which a vessel on even ground is seen
PLAIN_DROP = 6.0
#: attenuation from which a pixel is one of a device
DEVICE = 0.01


@dataclasses.dataclass(frozen=True, eq=False)
class GeneratedAngiogram:
    """One picture with its truth.

    Attributes
    ----------
    pixels : (SIDE, SIDE) uint8, vessels dark
    mask : (SIDE, SIDE) bool, coronary vessels alone
    unsure : (SIDE, SIDE) bool, twigs and faint vessels that an expert may draw or leave out
    device : (SIDE, SIDE) bool, catheter, wires, leads outside vessels
    path_px : (SIDE, SIDE) float32, chords through vessels, in pixel edges at the isocentre
    pixel_mm : float, at the isocentre
    """

    pixels: Array
    mask: Mask
    unsure: Mask
    device: Mask
    path_px: Image
    pixel_mm: float


def generated_angiogram(seed: int, index: int) -> GeneratedAngiogram:
    """Picture ``index`` of a stream; the same for the same arguments."""
    rng = np.random.default_rng([seed, index])
    pixel_mm = _between(rng, PIXEL_MM)
    contrast = _between(rng, CONTRAST)
    vessels = random_vessels(rng, SIDE, pixel_mm)
    path_px = moved(rng, vessels.path_px)
    if rng.random() < PLAIN:
        return _plain(rng, vessels.doubtful, path_px, pixel_mm)
    tube = spill = np.zeros_like(path_px)
    if rng.random() < CATHETERS:
        tube, spill = catheter(rng, vessels, pixel_mm)
    filled = np.maximum(path_px, tube) + spill
    patient, devices = scenery(rng, SIDE, pixel_mm)
    absorbed: Array = (
        contrast * pixel_mm * filled + cv2.GaussianBlur(patient, (0, 0), 0.7) + devices
    )
    light, field = exposed(rng, absorbed)
    seen = contrast * pixel_mm * path_px > FAINT
    mask = (path_px > SURE_PX) & ~vessels.doubtful & seen
    return GeneratedAngiogram(
        pixels=displayed(rng, light, field),
        mask=mask & field,
        unsure=(path_px > PERHAPS_PX) & ~mask & ~rim(mask) & field,
        device=((contrast * pixel_mm * tube > DEVICE) | (devices > DEVICE))
        & (path_px <= PERHAPS_PX)
        & field,
        path_px=np.where(field, path_px, np.float32(0)),
        pixel_mm=pixel_mm,
    )


def rim(mask: Mask) -> Mask:
    """Mask with what is so near to a sure vessel that it is the rim, which is not drawn."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _between(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    """Draw evenly on a logarithmic scale."""
    return float(np.exp(rng.uniform(*np.log(bounds))))


def _plain(
    rng: np.random.Generator, doubtful: Mask, path_px: Image, pixel_mm: float
) -> GeneratedAngiogram:
    """Dark vessels on an even ground, as deep as they are or drawn as flat areas."""
    flat = rng.random() < 0.5
    depth = np.clip(path_px, 0, 1) if flat else path_px / max(float(path_px.max()), 1.0)
    ground = float(rng.uniform(60, 255))
    drop = ground * float(rng.uniform(0.15, 1.0)) * depth
    light = ground - drop
    if rng.random() < 0.4:
        light = light + rng.normal(0, rng.uniform(0.5, 12), light.shape)
    # Thin twigs are as plain to see as anything: drawn flat, nothing is doubtful.
    mask = path_px > (0.5 if flat else SURE_PX)
    mask &= (flat | ~doubtful) & (drop > PLAIN_DROP)
    return GeneratedAngiogram(
        pixels=np.clip(light, 0, 255).round().astype(np.uint8),
        mask=mask,
        unsure=(path_px > PERHAPS_PX) & ~mask & ~rim(mask),
        device=np.zeros_like(mask),
        path_px=path_px,
        pixel_mm=pixel_mm,
    )


def network_input(pixels: Array) -> tuple[Array, Mask]:
    """Make the network's input of a picture with dark vessels, and where it shows nothing.

    Made by the code that makes it at run time, collimator search included.
    """
    counts = pixels.astype(np.float32)
    holes = collimator(counts)
    white = max(float(np.percentile(counts, 99.5)), 1e-12)
    return net_input(enhance.absorbance(counts / np.float32(white)), holes), holes


def asked_of(made: GeneratedAngiogram) -> Array:
    """(6, SIDE, SIDE) float32, what is asked where; see ``training_pair``."""
    weight = np.where(made.unsure, 0.0, 1.0)
    weight[made.device] = DEVICE_WEIGHT
    known = np.where(made.path_px > PERHAPS_PX, np.where(made.mask, 1.0, 0.0), 1.0)
    line = skeletonize(made.mask)
    layers = [made.mask, weight, made.path_px, made.device, known, line]
    return np.stack(layers).astype(np.float32)


def training_pair(seed: int, index: int) -> tuple[Array, Array]:
    """Return the network's input and truth of a picture, flipped at random.

    Returns
    -------
    channels : (CHANNELS, SIDE, SIDE) float32
    truth : (6, SIDE, SIDE) float32: vessel, weight of a pixel for that question, chord in pixel
        edges, device, weight of that question, centreline of the vessels
    """
    made = generated_angiogram(seed, index)
    channels, holes = network_input(made.pixels)
    truth = asked_of(made)
    truth[:, holes] = 0.0
    turn = np.random.default_rng([seed, index, 2]).integers(0, 2, 3)
    for axis in range(2):
        if turn[axis]:
            channels, truth = np.flip(channels, axis + 1), np.flip(truth, axis + 1)
    if turn[2]:
        channels, truth = channels.transpose(0, 2, 1), truth.transpose(0, 2, 1)
    return np.ascontiguousarray(channels), np.ascontiguousarray(truth)
