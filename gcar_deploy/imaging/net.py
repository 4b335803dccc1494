"""A small network that finds vessels: its input, its session, and lines from its answer.

The network sees the picture at a fixed number of pixels, flattened twice and scaled, beside the
ridge response of the classical method: three channels that look much alike in generated and real
pictures, whatever the display did to the grey values. It is told no pixel size: that is often
unknown or wrong, so the scale has to be found in the picture. It answers how probably a pixel is
vessel, and how long the chord through vessel is there, in pixel edges: a vessel's width is in the
picture, and a round vessel is as deep as it is wide. Which of the lines are catheters, leads or
wires a second network within the same file says (``line_strips``).
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from gcar_deploy.config import SEGMENTERS
from gcar_deploy.config.ranges import check_choice
from gcar_deploy.errors import ModelError
from gcar_deploy.imaging import enhance
from gcar_deploy.imaging.line_strips import NEAR, POINT, LinePoints
from gcar_deploy.imaging.resample import resize
from gcar_deploy.models import Kind, Session, read_model
from gcar_deploy.types import Array, Image, Mask, Scalars

#: sides of the network's input are multiples of this
STRIDE = 16
#: a picture is brought to the area of a square with this side, pixels, or, if it is finer, of one
#: with the second: thin vessels would be lost, and a picture blown up shows no more than it did
SIDE, FINEST_SIDE = 352, 448
#: of the longer side
_LONGEST = 1024
#: what the spec of a fitting model says of its input
INPUT = {"channels": 3, "stride": STRIDE, "side": SIDE, "point": POINT, "near": NEAR}
KIND = Kind("segmenter", "segmenter", INPUT)
#: finding where ``auto`` has no network
MISSING = f"{KIND.shipped}.onnx is not installed: vessels were found by the classical method alone"
INPUTS, OUTPUTS = ("channels", "points", "near"), ("probability", "chord", "device")
#: the second flattening is this much wider than the first: borders of lung and heart stay
_WIDER = 4.0
#: the filters take a pixel of the network for so much: most fields are near 352 times it
NOMINAL_MM = 0.5
#: a picture without noise has no spread: the unit is at least this share of its brightest lines
_LEAST_UNIT = 0.05


def network_scale(rows: int, columns: int, finest: int = FINEST_SIDE) -> float:
    """Pixels of the network for one of a picture of this size."""
    side = float(np.sqrt(rows * columns))
    return min(float(np.clip(side, SIDE, finest)) / side, _LONGEST / max(rows, columns))


def at_network_size(picture: Image, holes: Mask) -> tuple[Image, Mask]:
    """Return picture and holes at the size that the network looks at."""
    rows, columns = picture.shape
    scale = network_scale(rows, columns)
    size = (max(STRIDE, round(columns * scale)), max(STRIDE, round(rows * scale)))
    work = resize(enhance.fill_holes(picture, holes), size)
    return work, resize(holes.astype(np.float32), size) > 0.1


def net_input(picture: Image, holes: Mask) -> Array:
    """Make the network's input from a picture at the network's size.

    Parameters
    ----------
    picture : (rows, cols) float32, vessels bright
    holes : (rows, cols) bool, pixels without picture

    Returns
    -------
    (3, rows, cols) float32
        asinh of the picture without what varies slowly and without what varies very slowly, in
        robust standard deviations, and the ridge response in units of its 99th percentile, 0 .. 2;
        0 where there is no picture. A gain or an offset of ``picture`` changes nothing.
    """
    filled = enhance.fill_holes(picture, holes)
    sigma = enhance.FLATTEN_SIGMA_MM / NOMINAL_MM
    flat = enhance.flatten(filled, sigma)
    response = np.where(holes, np.float32(0), enhance.ridges(flat, NOMINAL_MM).response)
    inside = ~holes if not holes.all() else np.ones_like(holes)
    low, middle, bright = np.percentile(flat[inside], [16, 50, 99.5])
    top = float(np.percentile(response[inside], 99))
    # Vessels are in the upper tail: the spread is that of what lies below the median.
    scale = np.float32(max(float(middle - low), _LEAST_UNIT * float(bright - middle), 1e-9))
    near = np.arcsinh((flat - np.float32(middle)) / scale)
    wide = enhance.flatten(filled, _WIDER * sigma)
    far = np.arcsinh((wide - np.float32(np.median(wide[inside]))) / scale)
    ridge = np.clip(response / max(top, 1e-9), 0.0, 2.0)
    out = np.stack([near / 2, far / 2, ridge]).astype(np.float32)
    out[:, holes] = 0.0
    return out


@dataclasses.dataclass(frozen=True, eq=False)
class Seen:
    """Answer of the network.

    Attributes
    ----------
    probability : (rows, cols) float32, 0 .. 1, that the pixel is coronary vessel
    chord : (rows, cols) float32, >= 0, through vessel along the pixel's ray, pixel edges
    """

    probability: Image
    chord: Image


#: both networks of the file want all inputs: the least that the other one takes
_NO_LINES: dict[str, Array] = {
    "points": np.zeros((2, POINT), np.float32), "near": np.zeros((2, NEAR), np.int64),
}  # fmt: skip
_NO_PICTURE: dict[str, Array] = {
    "channels": np.zeros((1, INPUT["channels"], 2 * STRIDE, 2 * STRIDE), np.float32),
}  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class Segmenter:
    """Two networks in one file: one sees vessels in a picture, the other devices along its lines.

    Safe to share between threads.

    Attributes
    ----------
    session : models.Session of it
    should_stop : ends a running inference, see ``models.Session.run``; None lets it run
    turn : held while the network runs: it uses all cores, and its memory is that of one picture
    """

    session: Session
    should_stop: Callable[[], bool] | None = None
    turn: threading.Lock = dataclasses.field(default_factory=threading.Lock, repr=False)

    def watched(self, should_stop: Callable[[], bool] | None) -> Segmenter:
        """Return the same network, whose inference ends soon after ``should_stop`` says so."""
        return dataclasses.replace(self, should_stop=should_stop)

    def look(self, channels: Array) -> Seen:
        """Return what the network sees in a picture.

        Parameters
        ----------
        channels : (3, rows, cols) float32, from ``net_input``

        Raises
        ------
        ModelError, NumericalError, CancelledError
            As ``models.Session.run``.
        """
        _, rows, cols = channels.shape
        down, right = -rows % STRIDE, -cols % STRIDE
        padded = np.stack(
            [cv2.copyMakeBorder(c, 0, down, 0, right, cv2.BORDER_REPLICATE) for c in channels]
        )
        shape = (1, 1, rows + down, cols + right)
        maps = self._run(OUTPUTS[:2], [shape] * 2, _NO_LINES | {"channels": padded[None]})
        return Seen(*(np.ascontiguousarray(m[0, 0, :rows, :cols], np.float32) for m in maps))

    def devices(self, lines: LinePoints) -> Scalars:
        """(n,) float32, 0 .. 1, that a point of a line is of a device: of no vessel.

        Raises
        ------
        ModelError, NumericalError, CancelledError
            As ``models.Session.run``.
        """
        feed = _NO_PICTURE | {"points": lines.points, "near": lines.near}
        (found,) = self._run(OUTPUTS[2:], [(len(lines.points),)], feed)
        return np.asarray(found, np.float32)

    def _run(
        self, wanted: Sequence[str], shapes: list[tuple[int, ...]], feed: dict[str, Array]
    ) -> list[Array]:
        with self.turn:
            return self.session.run(feed, shapes, outputs=wanted, should_stop=self.should_stop)


def open_segmenter(path: Path, *, threads: int = 2) -> Segmenter:
    """Read, verify and open a segmentation network.

    Raises
    ------
    ModelError
        As ``models.read_model`` and ``models.Session``.
    """
    model = read_model(path, (KIND,))
    return Segmenter(Session(model, INPUTS, threads=threads, arena=False))


def load_segmenter(
    wanted: str, threads: int = 2, model: str | Path | None = None
) -> Segmenter | None:
    """Open the network where ``wanted`` needs it; None where ``auto`` finds none.

    Parameters
    ----------
    wanted : who finds vessels
    threads : int
    model : path of an ONNX file with its spec beside it; None for the shipped one

    Raises
    ------
    UsageError
        Nobody of that name finds vessels.
    ModelError
        ``net`` is wanted and the network is missing; the one given is missing, or it is altered.
    """
    check_choice("segmenter", wanted, SEGMENTERS)
    path = KIND.path if model is None else Path(model)
    if wanted == "classic" or (path is None and wanted == "auto"):
        return None
    if path is None:
        raise ModelError("no segmentation network is installed with this version; use classic")
    return open_segmenter(path, threads=threads)
