"""The Gaussian centre predictor through ONNX Runtime: the only file that imports it."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnxruntime as ort

from gcar_deploy.errors import ModelError, NumericalError
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.predict.candidates import Candidates
from gcar_deploy.predict.encoding import Encoded, flat_inputs, input_names
from gcar_deploy.predict.model_spec import ModelFile


class CenterPredictor:
    """A warm session of the multi-view predictor; safe to share between threads.

    Parameters
    ----------
    model : ModelFile, as ``read_model`` returns it
    threads : int, within one inference; spinning is off, so idle threads cost nothing
    session : an existing ``onnxruntime.InferenceSession`` of the same model, optional
    """

    def __init__(
        self, model: ModelFile, *, threads: int = 2, session: ort.InferenceSession | None = None
    ) -> None:
        self.model = model
        if session is None:
            options = ort.SessionOptions()
            options.intra_op_num_threads = threads
            options.inter_op_num_threads = 1
            options.log_severity_level = 3
            # A large first scene would otherwise keep its memory for good.
            options.enable_cpu_mem_arena = False
            options.add_session_config_entry("session.intra_op.allow_spinning", "0")
            try:
                session = ort.InferenceSession(
                    model.data, options, providers=["CPUExecutionProvider"]
                )
            except Exception as error:  # noqa: BLE001 - ONNX Runtime's errors share no base class
                reason = _first_line(error)
                raise ModelError(f"model {model.name} does not load: {reason}") from None
        self._session = session

    def predict(
        self, candidates: Candidates, encoded: Encoded, run_options: Any = None
    ) -> CenterPoints:
        """Judge every candidate.

        Parameters
        ----------
        candidates : Candidates (n points)
        encoded : Encoded, from ``encode`` with the same candidates
        run_options : onnxruntime.RunOptions, to terminate a running call

        Returns
        -------
        CenterPoints
            All n points with confidence, radius and the offset to the expected centreline.
        """
        feed = dict(zip(input_names(), flat_inputs(encoded), strict=True))
        out = self._session.run(None, feed, run_options)[0]
        if out.shape != (len(candidates), 5) or not np.isfinite(out).all():
            raise NumericalError(f"model {self.model.name} returned values that are not finite")
        h = candidates.spacing_mm
        return CenterPoints(
            points_mm=candidates.points_mm,
            confidence=out[:, 0].astype(np.float64),
            radius_mm=np.maximum(out[:, 4].astype(np.float64) * h, 0.1 * h),
            spacing_mm=h,
            source="multi",
            offset_mm=out[:, 1:4].astype(np.float64) * h,
        )


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0][:200] if str(error).strip() else type(error).__name__
