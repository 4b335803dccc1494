"""The Gaussian centre predictors: what goes into their networks, and centres from the answers."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from gcar_deploy.config import PredictOptions
from gcar_deploy.errors import ModelError, UsageError
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.models import Kind, ModelFile, Session
from gcar_deploy.predict.center_map import OUTPUTS, ViewCenters, decode, net_picture
from gcar_deploy.predict.encoding import Encoded, flat_inputs, input_names
from gcar_deploy.predict.hull import Candidates
from gcar_deploy.predict.kinds import MULTI, PAPER, PREDICTOR_KINDS, read_predictor
from gcar_deploy.types import Image

_log = logging.getLogger(__name__)


class CenterPredictor:
    """The multi-view predictor.

    Parameters
    ----------
    model : ModelFile of its kind
    threads, session : as ``threads`` and ``runtime`` of ``models.Session``
    """

    def __init__(self, model: ModelFile, *, threads: int = 2, session: Any = None) -> None:
        self.model = model
        self.session = Session(model, input_names(), threads=threads, runtime=session)

    def predict(
        self,
        candidates: Candidates,
        encoded: Encoded,
        should_stop: Callable[[], bool] | None = None,
    ) -> CenterPoints:
        """Judge every candidate.

        Parameters
        ----------
        candidates : Candidates (n points)
        encoded : Encoded, from ``encode`` with the same candidates
        should_stop : ends a running inference, see ``models.Session.run``

        Returns
        -------
        CenterPoints
            All n points with confidence, radius and the offset to the expected centreline.

        Raises
        ------
        ModelError, NumericalError, CancelledError
            As ``models.Session.run``.
        """
        feed = dict(zip(input_names(), flat_inputs(encoded), strict=True))
        (out,) = self.session.run(feed, [(len(candidates), 5)], should_stop=should_stop)
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
    """The paper's single-view predictor. Takes what ``CenterPredictor`` takes."""

    def __init__(self, model: ModelFile, *, threads: int = 2, session: Any = None) -> None:
        self.model = model
        self.session = Session(model, self.input_names(), threads=threads, runtime=session)

    @property
    def directions_deg(self) -> list[list[float]]:
        """(primary, secondary) of the views that the model was trained on; none: any."""
        directions: list[list[float]] = self.model.inputs["directions_deg"]
        return directions

    def input_names(self) -> list[str]:
        """Names of the graph's inputs; the axes only where the model is told the pose."""
        return ["picture", "axes"] if self.model.inputs["pose"] else ["picture"]

    def predict(
        self,
        views: Sequence[tuple[CArm, Image]],
        should_stop: Callable[[], bool] | None = None,
    ) -> list[ViewCenters]:
        """Predict centres in every view on its own.

        Parameters
        ----------
        views : sequence of (CArm, path_mm), (rows, columns) path length in mm, any size
        should_stop : as in ``CenterPredictor.predict``

        Returns
        -------
        ViewCenters per view, lifted along its true rays

        Raises
        ------
        ModelError, NumericalError, CancelledError
            As ``CenterPredictor.predict``.
        """
        pixels, alpha = int(self.model.inputs["pixels"]), int(self.model.inputs["alpha"])
        shape = (1, OUTPUTS, pixels // alpha, pixels // alpha)
        found = []
        # One picture a call: memory does not grow with the number of views.
        for carm, path in views:
            picture = net_picture(carm, path, pixels)
            arrays = (picture.network_input(), picture.axes_input())
            feed = dict(zip(self.input_names(), arrays, strict=False))
            (out,) = self.session.run(feed, [shape], should_stop=should_stop)
            found.append(decode(out[0], picture, alpha))
        return found


#: either predictor, as the engine holds it
Predictor: TypeAlias = CenterPredictor | SingleViewPredictor


def open_predictor(model: ModelFile, *, threads: int = 2, session: Any = None) -> Predictor:
    """Return the predictor that a model file is made for."""
    opened = SingleViewPredictor if model.kind == PAPER.name else CenterPredictor
    return opened(model, threads=threads, session=session)


def load_predictor(
    model: str | Path | None, options: PredictOptions, *, threads: int = 2, session: Any = None
) -> Predictor | None:
    """Open the predictor that ``options`` ask for; None where there is none.

    Parameters
    ----------
    model : path of an ONNX file; None for the shipped one
    options : PredictOptions
    threads, session : as of ``CenterPredictor``

    Raises
    ------
    UsageError
        A model was given for nobody.
    ModelError
        The model is missing, altered, unfit, or of another kind than the one asked for.
    """
    wanted = options.predictor
    if wanted == "none":
        if model is not None:
            raise UsageError("predictor none uses no model; leave the model away")
        return None
    path = _shipped(wanted).path if model is None else Path(model)
    if path is None:
        _log.info("%s", missing_predictor(wanted))
        return None
    file = read_predictor(path, options.limits)
    if wanted not in ("auto", file.kind):
        raise ModelError(f"model {file.name} is of kind {file.kind}, not {wanted}")
    return open_predictor(file, threads=threads, session=session)


def missing_predictor(wanted: str) -> str:
    """Say what a missing shipped model means."""
    return f"{_shipped(wanted).shipped}.onnx is not installed: the visual hull was thinned instead"


def _shipped(wanted: str) -> Kind:
    return PREDICTOR_KINDS.get(wanted, MULTI)
