"""Make the golden case of a model: a small input and what the model says to it today."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gcar_deploy.config import CandidateOptions
from gcar_deploy.errors import UsageError
from gcar_deploy.imaging.line_strips import POINT, near_points
from gcar_deploy.imaging.net import KIND as SEGMENTER
from gcar_deploy.imaging.net import open_segmenter
from gcar_deploy.models import (
    Golden,
    ModelFile,
    Session,
    check_golden,
    golden_path,
    read_model,
)
from gcar_deploy.predict.center_map import net_picture
from gcar_deploy.predict.center_predictor import open_predictor
from gcar_deploy.predict.encoding import encode, flat_inputs, input_names
from gcar_deploy.predict.hull import Candidates, visual_hull
from gcar_deploy.predict.kinds import PREDICTOR_KINDS
from gcar_deploy.selftest import tiny_case

#: points of the case: enough for every level and for rays of several points, small on disk
POINTS = 500
#: lengths of the lines of the case
LINES = (7, 40, 90)


def golden_inputs(model: ModelFile) -> dict[str, np.ndarray]:
    """Return the inputs that a part of the self-test's tree gives, by name."""
    angiograms, grid, _ = tiny_case()
    # path_length pictures: counts times mm per count
    views = [(a.carm, a.pixels * np.float32(a.intensity.mm_per_count)) for a in angiograms]
    if model.kind == SEGMENTER.name:
        shape = (1, int(model.inputs["channels"]), 64, 64)
        rng = np.random.default_rng(0)
        noise, near = rng.normal(size=shape), near_points(LINES)
        points = rng.normal(size=(len(near), POINT)).astype(np.float32)
        channels = np.clip(noise, -1, 2).astype(np.float32)
        return {"channels": channels, "points": points, "near": near}
    if model.kind == "paper":
        picture = net_picture(*views[0], int(model.inputs["pixels"]))
        arrays = [picture.network_input(), picture.axes_input()]
        return dict(zip(["picture", "axes"][: 1 + model.inputs["pose"]], arrays, strict=False))
    hull = visual_hull(views, grid, CandidateOptions())
    some = np.linspace(0, len(hull) - 1, 2 * POINTS).astype(np.int64)[:POINTS]
    part = Candidates(hull.index[some], hull.points_mm[some], hull.lattice)
    arrays = flat_inputs(encode(part, [(carm, path, True) for carm, path in views]))
    return dict(zip(input_names(), arrays, strict=True))


def write_golden(model: Path, *, force: bool = False) -> Path:
    """Run ``model`` once and write its golden case beside it.

    Raises
    ------
    UsageError
        There is one already (without ``force``).
    ModelError
        The model is not what its spec says.
    """
    path = golden_path(model)
    if path.exists() and not force:
        raise UsageError(f"{path} exists; add --force to replace it")
    old = path.with_suffix(".npz.old")
    if path.exists():
        # A golden case of an earlier model would be refused with it.
        path.replace(old)
    try:
        session = _opened(model)
        inputs = golden_inputs(session.model)
        answers = session.answers(inputs)
        golden = Golden(session.model.sha256, inputs, answers)
        path.write_bytes(golden.to_bytes())
        check_golden(model.name, golden, lambda names, feed: list(answers.values()))
    except BaseException:
        path.unlink(missing_ok=True)
        if old.exists():
            old.replace(path)
        raise
    old.unlink(missing_ok=True)
    return path


def _opened(path: Path) -> Session:
    """Open a model of any kind."""
    file = read_model(path, (*PREDICTOR_KINDS.values(), SEGMENTER))
    if file.kind == SEGMENTER.name:
        return open_segmenter(path, threads=1).session
    return open_predictor(file, threads=1).session
