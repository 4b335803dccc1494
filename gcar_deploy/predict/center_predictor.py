"""The Gaussian centre predictors through ONNX Runtime: the only file that imports it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import onnxruntime as ort

from gcar_deploy.errors import ModelError, NumericalError
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.predict.candidates import Candidates
from gcar_deploy.predict.center_map import (
    OUTPUTS,
    ViewCenters,
    decode,
    golden_inputs,
    net_picture,
    single_input_names,
)
from gcar_deploy.predict.encoding import Encoded, flat_inputs, input_names
from gcar_deploy.predict.model_spec import ModelFile
from gcar_deploy.types import Array, Image


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
        self._session = _open(model, threads) if session is None else session

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


class SingleViewPredictor:
    """A warm session of the paper's single-view predictor; safe to share between threads.

    Takes what ``CenterPredictor`` takes.
    """

    def __init__(
        self, model: ModelFile, *, threads: int = 2, session: ort.InferenceSession | None = None
    ) -> None:
        self.model = model
        self.pixels, self.alpha = int(model.inputs["pixels"]), int(model.inputs["alpha"])
        self._pose = bool(model.inputs["pose"])
        self._session = _open(model, threads) if session is None else session
        self._check_golden()

    def _check_golden(self) -> None:
        """Refuse a library or processor that makes something else of the graph than training."""
        golden = self.model.spec.get("golden")
        if not isinstance(golden, dict):
            return
        answer = self._answer(golden_inputs(self.pixels, self._pose), None)
        answer = answer.reshape(OUTPUTS, -1).astype(np.float64)
        found = {"mean": answer.mean(axis=1), "std": answer.std(axis=1)}
        for key, value in found.items():
            if not np.allclose(value, golden.get(key, np.nan), rtol=1e-3, atol=1e-4):
                raise ModelError(
                    f"model {self.model.name} does not give its golden output on this machine"
                )

    def predict(
        self, views: Sequence[tuple[CArm, Image]], run_options: Any = None
    ) -> list[ViewCenters]:
        """Predict centres in every view on its own.

        Parameters
        ----------
        views : sequence of (CArm, path_mm), (rows, columns) path length in mm, any size
        run_options : onnxruntime.RunOptions, to terminate a running call

        Returns
        -------
        ViewCenters per view, lifted along its true rays
        """
        pictures = [net_picture(carm, path, self.pixels) for carm, path in views]
        # One picture a call: memory does not grow with the number of views.
        feeds = [[p.network_input(), p.axes_input()][: 1 + self._pose] for p in pictures]
        answers = [self._answer(feed, run_options) for feed in feeds]
        return [decode(a, p, self.alpha) for a, p in zip(answers, pictures, strict=True)]

    def _answer(self, arrays: Sequence[Array], run_options: Any) -> Array:
        """(4, m, m) from (1, 1, n, n) and, for some models, (1, 3, 3)."""
        feed = dict(zip(single_input_names(self._pose), arrays, strict=True))
        out = self._session.run(None, feed, run_options)[0]
        m = self.pixels // self.alpha
        if out.shape != (1, OUTPUTS, m, m) or not np.isfinite(out).all():
            raise NumericalError(f"model {self.model.name} returned values that are not finite")
        answer: Array = out[0]
        return answer


#: either predictor, as the engine holds it
Predictor: TypeAlias = CenterPredictor | SingleViewPredictor


def open_predictor(model: ModelFile, *, threads: int = 2, session: Any = None) -> Predictor:
    """Return the predictor that a model file is made for."""
    kind = SingleViewPredictor if model.kind == "single" else CenterPredictor
    return kind(model, threads=threads, session=session)


def _open(model: ModelFile, threads: int) -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    # A large first scene would otherwise keep its memory for good.
    options.enable_cpu_mem_arena = False
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return ort.InferenceSession(model.data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # noqa: BLE001 - ONNX Runtime's errors share no base class
        reason = _first_line(error)
        raise ModelError(f"model {model.name} does not load: {reason}") from None


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0][:200] if str(error).strip() else type(error).__name__
