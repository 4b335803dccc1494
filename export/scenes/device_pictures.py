"""Pictures that a network learns catheters, leads and wires from, ready for it.

Of each three one is a frame of a generated run (``cine``), one a generated angiogram
(``angiograms``), one a real angiogram with the vessels as an expert drew them, where there are
any. Most get further devices (``drawn_devices``). All are whole pictures, as at run time: where a
picture ends says where devices come from. The segmenter's answer is part of the input.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gcar_deploy.imaging.net import SIDE, Segmenter
from gcar_deploy.types import Array, Image, Mask
from gcar_export.scenes import augmented, cine, drawn_devices, picture_pool
from gcar_export.scenes.angiograms import PERHAPS_PX, generated_angiogram
from gcar_export.scenes.augmented import Labelled, augmented_pair
from gcar_export.scenes.cine import cine_pair
from gcar_export.scenes.drawn_devices import drawn_devices as drawn
from gcar_export.scenes.expert_pictures import ExpertPicture

#: enlargement of a picture that fills the network's field, and how far it is turned, degrees
ZOOM, TURN_DEG = (1.0, 1.2), 8.0
#: of the pictures this share gets further devices; what they absorb at least to be one
FURTHER, SEEN = 0.6, 0.02
#: a step between the numbers of patients, and of angiograms, of two seeds
_SEED = 31_000
#: weight of what is neither vessel nor device where that is known, and of a vessel
GROUND, VESSEL = 0.2, 2.0


@dataclasses.dataclass(frozen=True, eq=False)
class DevicePicture:
    """One picture as the network is given it.

    Attributes
    ----------
    channels : (6, SIDE, SIDE) float16: ``net.net_input``, then the probability, the chord and the
        own device map of the segmenter
    device : (SIDE, SIDE) bool
    weight : (SIDE, SIDE) float16, how much a pixel counts; 0 where nobody knows
    """

    channels: Array
    device: Mask
    weight: Array


def device_picture(
    seed: int, index: int, segmenter: Segmenter, real: Sequence[ExpertPicture] = ()
) -> DevicePicture:
    """Picture ``index`` of a stream; the same for the same arguments."""
    rng = np.random.default_rng([seed, index, 6])
    kind = index % 3
    if kind == 2 and real:
        chosen = real[int(rng.integers(len(real)))]
        pixels, vessel = chosen.pixels, chosen.mask
        device, ground = np.zeros_like(vessel), np.float32(0)
    elif kind == 1:
        made = generated_angiogram(_SEED + seed, index)
        pixels, vessel, device = made.pixels, made.path_px > PERHAPS_PX, made.device
        ground = np.float32(GROUND)
    else:
        pixels, vessel, device = _frame(rng, _SEED + seed, index)
        ground = np.float32(GROUND)
    shape = min(vessel.shape)
    if rng.random() < FURTHER and vessel.shape == (shape, shape):
        absorbed = drawn(rng, shape)
        pixels = np.asarray(pixels, np.float32) * np.exp(-absorbed)
        device = (device | (absorbed > SEEN)) & ~vessel
    weight = np.where(vessel, np.float32(VESSEL), np.where(device, np.float32(1), ground))
    return _ready(rng, np.asarray(pixels, np.float32), vessel, device, weight, segmenter)


def _frame(rng: np.random.Generator, seed: int, index: int) -> tuple[Array, Mask, Mask]:
    """Pixels, vessel and device of one of the fuller frames of a generated run."""
    run = cine_pair(seed, index, 4).runs[int(rng.integers(2))]
    filled = run.path_mm.sum(axis=(1, 2))
    frame = int(np.argsort(filled)[-1 - int(rng.integers(2))])
    least = PERHAPS_PX * run.carm.pixel_at_isocenter_mm
    return run.pixels[frame], run.path_mm[frame] > least, run.device[frame]


def _ready(
    rng: np.random.Generator, pixels: Image, vessel: Mask, device: Mask, weight: Image,
    segmenter: Segmenter,
) -> DevicePicture:  # fmt: skip
    """Bring a picture to the network's size, never twice the same, and ask the segmenter."""
    zero = np.zeros_like(weight)
    scale = SIDE / float(np.sqrt(pixels.size))
    layers = np.stack([vessel, weight, zero, device, zero, zero]).astype(np.float32)
    given = Labelled(pixels, layers, (scale * ZOOM[0], scale * ZOOM[1]))
    channels, truth = augmented_pair(rng, given, SIDE, TURN_DEG)
    seen = segmenter.look(channels)
    answers = np.stack([seen.probability, seen.chord, seen.device])
    return DevicePicture(
        channels=np.concatenate([channels, answers]).astype(np.float16),
        device=truth[3] > 0.5,
        weight=truth[1].astype(np.float16),
    )


def generator(segmenter: str, real: Sequence[ExpertPicture]) -> str:
    """Return a hash of what draws: pictures of another generator, network or folder are others.

    ``segmenter``: SHA-256 of its file.
    """
    modules = (augmented, cine, drawn_devices)
    texts = [Path(str(m.__file__)).read_bytes() for m in modules] + [Path(__file__).read_bytes()]
    names = " ".join(picture.name for picture in real)
    words = f"{picture_pool.generator()} {segmenter} {names}"
    return hashlib.sha256(b"".join([*texts, words.encode()])).hexdigest()[:12]


def pooled_device_picture(
    folder: Path, stream: str, seed: int, index: int, segmenter: Segmenter,
    real: Sequence[ExpertPicture],
) -> DevicePicture:  # fmt: skip
    """Picture ``index`` of a stream, drawn where the folder does not hold it yet.

    ``stream``: what ``generator`` says.
    """
    path = folder / f"{stream}-{seed}-{index:06d}.npz"
    if not path.exists():
        made = device_picture(seed, index, segmenter, real)
        folder.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}.tmp")
        with part.open("wb") as file:
            np.savez(file, channels=made.channels, device=made.device, weight=made.weight)
        part.replace(path)
    with np.load(path) as data:
        return DevicePicture(data["channels"], data["device"], data["weight"])


def turned(rng: np.random.Generator, picture: DevicePicture) -> DevicePicture:
    """Flip and transpose at random."""
    arrays = [picture.channels, picture.device, picture.weight]
    flip = rng.integers(0, 2, 3)
    for axis in (-1, -2):
        if flip[axis]:
            arrays = [np.flip(a, axis) for a in arrays]
    if flip[2]:
        arrays = [np.swapaxes(a, -1, -2) for a in arrays]
    return DevicePicture(*(np.ascontiguousarray(a) for a in arrays))


def cropped(rng: np.random.Generator, picture: DevicePicture, side: int) -> DevicePicture:
    """Cut a square of ``side`` pixels out, anywhere."""
    top, left = rng.integers(0, picture.device.shape[0] - side + 1, 2)
    part = slice(top, top + side), slice(left, left + side)
    return DevicePicture(
        *(a[..., *part] for a in (picture.channels, picture.device, picture.weight))
    )
