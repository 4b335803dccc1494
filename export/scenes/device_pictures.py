"""Pictures whose lines a network learns catheters, leads and wires from, ready for it.

Of each four one is a frame of a generated run (``cine``), one a generated angiogram
(``angiograms``), one a raw picture of a generated tree (``raw_angiograms``), one a real angiogram
with the vessels as an expert drew them, where there are any. Most get further devices
(``drawn_devices``). All are whole pictures, as at run time: where a picture ends says where devices
come from. What is kept of a picture are its lines, as the run time looks along them.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from gcar_deploy.files import whole_file
from gcar_deploy.imaging import learned, line_chains, line_strips
from gcar_deploy.imaging.learned import vessel_lines
from gcar_deploy.imaging.line_strips import LinePoints, line_points
from gcar_deploy.imaging.net import SIDE, Segmenter
from gcar_deploy.types import Array, Mask
from gcar_export.scenes import augmented, cine, drawn_devices, picture_pool
from gcar_export.scenes.angiograms import PERHAPS_PX, generated_angiogram
from gcar_export.scenes.augmented import Labelled, augmented_pair
from gcar_export.scenes.cine import cine_pair
from gcar_export.scenes.drawn_devices import drawn_devices as drawn
from gcar_export.scenes.expert_pictures import ExpertPicture
from gcar_export.scenes.raw_angiograms import raw_angiogram

#: enlargement of a picture that fills the network's field, and how far it is turned, degrees
ZOOM, TURN_DEG = (1.0, 1.2), 8.0
#: of the pictures this share gets further devices; what they absorb at least to be one
FURTHER, SEEN = 0.6, 0.02
#: a step between the numbers of patients, and of angiograms, of two seeds
_SEED = 31_000
#: what a point of a line is; of an expert's picture only what is no vessel is known
VESSEL, DEVICE, OTHER, NO_VESSEL, NOT_ASKED = 0, 1, 2, 3, -1
#: so near to a vessel, and to a device, nobody says which a line is, pixels to each side
_NEAR_VESSEL, _NEAR_DEVICE = np.ones((5, 5), np.uint8), np.ones((3, 3), np.uint8)


@dataclasses.dataclass(frozen=True, eq=False)
class DevicePicture:
    """The lines of one picture.

    Attributes
    ----------
    lines : LinePoints
    label : (n,) int8, ``VESSEL`` .. ``NOT_ASKED`` of each point
    """

    lines: LinePoints
    label: Array


def device_picture(
    seed: int, index: int, segmenter: Segmenter, real: Sequence[ExpertPicture] = ()
) -> DevicePicture:
    """Picture ``index`` of a stream; the same for the same arguments."""
    rng = np.random.default_rng([seed, index, 6])
    kind, expert = index % 4, False
    if kind == 2 and real:
        chosen = real[int(rng.integers(len(real)))]
        pixels, vessel, expert = chosen.pixels, chosen.mask, True
        device = np.zeros_like(vessel)
    elif kind == 0:
        pixels, vessel, device = _frame(rng, _SEED + seed, index)
    elif kind == 3:
        made = raw_angiogram(rng)
        pixels, vessel, device = made.pixels, made.path_px > PERHAPS_PX, made.device
    else:
        made = generated_angiogram(_SEED + seed, index)
        pixels, vessel, device = made.pixels, made.path_px > PERHAPS_PX, made.device
    pixels = np.asarray(pixels, np.float32)
    if rng.random() < FURTHER and vessel.shape[0] == vessel.shape[1]:
        absorbed = drawn(rng, vessel.shape[0])
        pixels = pixels * np.exp(-absorbed)
        device = (device | (absorbed > SEEN)) & ~vessel
    return _looked_at(rng, pixels, vessel, device, expert, segmenter)


def _frame(rng: np.random.Generator, seed: int, index: int) -> tuple[Array, Mask, Mask]:
    """Pixels, vessel and device of one of the fuller frames of a generated run."""
    run = cine_pair(seed, index, 4).runs[int(rng.integers(2))]
    filled = run.path_mm.sum(axis=(1, 2))
    frame = int(np.argsort(filled)[-1 - int(rng.integers(2))])
    least = PERHAPS_PX * run.carm.pixel_at_isocenter_mm
    return run.pixels[frame], run.path_mm[frame] > least, run.device[frame]


def _looked_at(
    rng: np.random.Generator, pixels: Array, vessel: Mask, device: Mask, expert: bool,
    segmenter: Segmenter,
) -> DevicePicture:  # fmt: skip
    """Bring a picture to the network's size, never twice the same, and look along its lines."""
    zero = np.zeros(vessel.shape, np.float32)
    scale = SIDE / float(np.sqrt(pixels.size))
    layers = np.stack([vessel, zero, zero, device, zero, zero]).astype(np.float32)
    given = Labelled(pixels, layers, (scale * ZOOM[0], scale * ZOOM[1]))
    channels, truth = augmented_pair(rng, given, SIDE, TURN_DEG)
    seen = segmenter.look(channels)
    dark = (np.abs(channels).sum(axis=0) == 0).astype(np.uint8)
    holes = cv2.morphologyEx(dark, cv2.MORPH_OPEN, _NEAR_VESSEL) > 0
    line = vessel_lines(np.where(holes, np.float32(0), seen.probability))[1]
    maps = np.concatenate([channels, seen.probability[None], seen.chord[None]])
    lines = line_points(maps, line, holes)
    label = labels(truth[0] > 0.5, truth[3] > 0.5, expert)
    return DevicePicture(lines, label[lines.pixels[:, 0], lines.pixels[:, 1]])


def labels(vessel: Mask, device: Mask, expert: bool) -> Array:
    """(rows, cols) int8, what a line is there; ``expert``: only vessels were drawn."""
    beside = cv2.dilate(vessel.astype(np.uint8), _NEAR_VESSEL) > 0
    on_device = cv2.dilate(device.astype(np.uint8), _NEAR_DEVICE) > 0
    out = np.where(on_device, DEVICE, NO_VESSEL if expert else OTHER)
    out = np.where(beside, NOT_ASKED, out)
    return np.where(vessel, VESSEL, out).astype(np.int8)


def generator(segmenter: str, real: Sequence[ExpertPicture]) -> str:
    """Return a hash of what draws: pictures of another generator, network or folder are others.

    ``segmenter``: SHA-256 of its file.
    """
    modules = (augmented, cine, drawn_devices, learned, line_chains, line_strips)
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
        with whole_file(path) as part, part.open("wb") as file:
            np.savez(
                file, points=made.lines.points.astype(np.float16), label=made.label,
                pixels=made.lines.pixels.astype(np.int16), lengths=made.lines.lengths,
            )  # fmt: skip
    with np.load(path) as data:
        lengths = tuple(int(n) for n in data["lengths"])
        near = line_strips.near_points(lengths)
        points = data["points"].astype(np.float32)
        return DevicePicture(LinePoints(data["pixels"], points, near, lengths), data["label"])
