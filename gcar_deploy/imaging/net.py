"""A small network that finds vessels: its input, its session, and lines from its answer.

The network sees the picture at a known pixel size, flattened and scaled, beside the ridge
response of the classical method: two channels that look much alike in generated and real
pictures, whatever the display did to the grey values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from gcar_deploy.config import ImagingOptions
from gcar_deploy.errors import ModelError, NumericalError
from gcar_deploy.imaging import enhance
from gcar_deploy.types import Array, Image, Mask

#: sides of the network's input are multiples of this
STRIDE = 8
#: what the spec of a fitting model says of its input
INPUT = {"channels": 2, "stride": STRIDE}
_CLIP = 4.0


def net_input(flat: Image, response: Image, valid: Mask) -> Array:
    """Scale a flattened picture and its ridge response for the network.

    Parameters
    ----------
    flat : (rows, cols) float32, vessels bright, slow background taken away
    response : (rows, cols) float32, as ``enhance.ridges`` gives it
    valid : (rows, cols) bool

    Returns
    -------
    (2, rows, cols) float32: units of robust standard deviations and of the 99th percentile,
    clipped; 0 where there is no picture
    """
    inside = valid if valid.any() else np.ones_like(valid)
    middle = float(np.median(flat[inside]))
    # Vessels are in the upper tail: the spread is that of what lies below the median.
    low = middle - float(np.percentile(flat[inside], 16))
    top = float(np.percentile(response[inside], 99))
    picture = np.clip((flat - middle) / max(low, 1e-9), -_CLIP, 2 * _CLIP) / _CLIP
    ridge = np.clip(response / max(top, 1e-9), 0.0, 2.0)
    out = np.stack([picture, ridge]).astype(np.float32)
    out[:, ~valid] = 0.0
    return out


def prepared(picture: Image, holes: Mask, pixel_mm: float, options: ImagingOptions) -> Array:
    """Make the network's input from a picture at working size; see ``net_input``."""
    flat = enhance.flatten(enhance.fill_holes(picture, holes), options.flatten_sigma_mm / pixel_mm)
    response = enhance.ridges(flat, pixel_mm, options).response
    return net_input(flat, np.where(holes, np.float32(0), response), ~holes)


class Segmenter:
    """A warm session of the segmentation network; safe to share between threads.

    Parameters
    ----------
    data : bytes of the ONNX file
    name : str, for messages
    threads : int, within one inference
    """

    def __init__(self, data: bytes, name: str, *, threads: int = 2) -> None:
        import onnxruntime as ort

        self.name = name
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        options.enable_cpu_mem_arena = False
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session: Any = ort.InferenceSession(
                data, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # noqa: BLE001 - ONNX Runtime's errors share no base class
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
            raise ModelError(f"model {name} does not load: {reason}") from None

    def run(self, outputs: Sequence[str] | None, feed: Mapping[str, Array]) -> list[Array]:
        """Run the graph on named inputs.

        Raises
        ------
        ModelError
            It cannot run on them.
        """
        try:
            found: list[Array] = self._session.run(outputs, dict(feed))
        except Exception as error:  # noqa: BLE001 - ONNX Runtime's errors share no base class
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
            raise ModelError(f"model {self.name} fails: {reason}") from None
        return found

    def output_names(self) -> list[str]:
        """Names of the graph's outputs."""
        return [node.name for node in self._session.get_outputs()]

    def probability(self, channels: Array) -> Image:
        """Return the vessel probability of each pixel.

        Parameters
        ----------
        channels : (2, rows, cols) float32, from ``net_input``

        Returns
        -------
        (rows, cols) float32, 0 .. 1

        Raises
        ------
        NumericalError
            The model returned what is not finite.
        """
        _, rows, cols = channels.shape
        down, right = -rows % STRIDE, -cols % STRIDE
        padded = np.stack(
            [cv2.copyMakeBorder(c, 0, down, 0, right, cv2.BORDER_REPLICATE) for c in channels]
        )
        out = self.run(None, {"channels": padded[None]})[0]
        if out.shape != (1, 1, rows + down, cols + right) or not np.isfinite(out).all():
            raise NumericalError(f"model {self.name} returned values that are not finite")
        return np.asarray(out[0, 0, :rows, :cols], dtype=np.float32)
