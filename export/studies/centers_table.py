"""Predicted centres on real trees: how good they are, and what a prediction costs."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gcar_deploy.errors import UsageError
from gcar_deploy.predict.center_map import net_picture
from gcar_deploy.predict.center_predictor import Predictor, SingleViewPredictor, open_predictor
from gcar_deploy.predict.centers import Seen
from gcar_deploy.predict.encoding import flat_inputs, input_names
from gcar_deploy.predict.kinds import PREDICTOR_KINDS, read_predictor
from gcar_deploy.types import Array
from gcar_export.evaluate.evaluate import find_labels
from gcar_export.methods.predictor_process import peak_mib
from gcar_export.methods.rtk_timing import pair_carms, projection_pair
from gcar_export.scenes.label_trees import capsules_of
from gcar_export.scenes.labels import read_label
from gcar_export.scenes.protocols import Case, make_case
from gcar_export.studies.centers import Truth, depth_error_px, pose, predicted

#: how near counts, voxels of the protocol's grid (1.41 mm paper, 1 mm clinical)
REACH_VOXELS = 1.5


@dataclasses.dataclass(frozen=True)
class Row:
    """One model on one tree: shares of centres and of centreline, 0 .. 1.

    ``depth_px`` is the median error of depth, pixel edges, for predictors of single views.
    """

    case: str
    name: str
    precision: float
    recall: float
    centers: int
    depth_px: float | None = None


@dataclasses.dataclass(frozen=True)
class Cost:
    """What both views of one case cost.

    Attributes
    ----------
    name : of the model, as ``open_models`` gives it
    pairs : inference over one itk-rtk forward and back projection (128^3 voxels, two 128 x 128
        views), wall-clock
    cpu_pairs : the same of processor seconds, which other load on the machine hardly touches
    seconds, pair_seconds : medians of timings taken in turns in this process
    peak_mib : peak memory of a process that only runs the predictor
    """

    name: str
    pairs: float
    cpu_pairs: float
    seconds: float
    pair_seconds: float
    peak_mib: float


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """A predictor that is open, its file, and the name that its rows have."""

    name: str
    path: Path
    predictor: Predictor


def open_models(names: Sequence[str]) -> list[Model]:
    """Open shipped models by kind (``multi``, ``paper``) or any by path.

    One by path is named by its file, by its path where two files are named alike.

    Raises
    ------
    UsageError
        A kind has no shipped model, or one model is named twice.
    ModelError
        A file is missing or altered.
    """
    out = []
    files = [Path(name).name for name in names]
    for k, name in enumerate(names):
        if name in names[:k]:
            raise UsageError(f"models: {name} is named twice")
        path = PREDICTOR_KINDS[name].path if name in PREDICTOR_KINDS else Path(name)
        if path is None:
            raise UsageError(f"no {name} model is installed; give the path of one")
        label = files[k] if files.count(files[k]) == 1 else name
        out.append(Model(name=label, path=path, predictor=open_predictor(read_predictor(path))))
    return out


def measure(
    data: Path,
    protocol: str,
    models: Sequence[Model],
    cases: Sequence[str] = (),
    progress: Callable[[int, int, str], None] | None = None,
) -> list[Row]:
    """Predict every tree of ``data`` with every model."""
    files = find_labels(data, cases)
    rows: list[Row] = []
    for done, file in enumerate(files):
        case = make_case(read_label(file), protocol)
        posed, truth = pose(case.angiograms(), case.grid), Truth.of(case.truth, case.grid)
        reach = REACH_VOXELS * float(np.mean(case.grid.spacing_mm))
        for model in models:
            depth = None
            if isinstance(model.predictor, SingleViewPredictor):
                depth = depth_error_px(model.predictor, posed, capsules_of(case.label))
            centers = predicted(model.predictor, posed)
            precision, recall = truth.scores(centers, reach)
            rows.append(Row(case.name, model.name, precision, recall, len(centers), depth))
        if progress:
            progress(done + 1, len(files), case.name)
    return rows


def cost(
    data: Path,
    protocol: str,
    models: Sequence[Model],
    cases: Sequence[str] = (),
    repeats: int = 7,
) -> list[Cost]:
    """Time inference and projections in turns on the first case; measure memory."""
    files = find_labels(data, cases)
    case = make_case(read_label(files[0]), protocol)
    posed = pose(case.angiograms(), case.grid)
    work = {"pair": _pair(case)}
    for model in models:
        work[model.name] = _inference(model.predictor, posed)
    wall: dict[str, list[float]] = {name: [] for name in work}
    cpu: dict[str, list[float]] = {name: [] for name in work}
    for round_ in range(repeats + 1):
        for name, run in work.items():
            start, begun = time.perf_counter(), time.process_time()
            run()
            if round_:
                wall[name].append(time.perf_counter() - start)
                cpu[name].append(time.process_time() - begun)
    seconds, processor = (
        {name: statistics.median(values) for name, values in of.items()} for of in (wall, cpu)
    )
    return [
        Cost(
            name=model.name,
            pairs=seconds[model.name] / seconds["pair"],
            cpu_pairs=processor[model.name] / processor["pair"],
            seconds=seconds[model.name],
            pair_seconds=seconds["pair"],
            peak_mib=peak_mib(model.path, _feed(model.predictor, posed)),
        )
        for model in models
    ]


def _pair(case: Case) -> Callable[[], None]:
    forward, back = projection_pair(case.truth, case.grid, pair_carms())

    def run() -> None:
        forward()
        back()

    return run


def _inference(predictor: Predictor, posed: Seen) -> Callable[[], Any]:
    if isinstance(predictor, SingleViewPredictor):
        views = [(view.carm, view.path_mm) for view in posed.views]
        return lambda: predictor.predict(views)
    return lambda: predictor.predict(posed.hull, posed.encoded)


def _feed(predictor: Predictor, posed: Seen) -> dict[str, Array]:
    """Return one inference's inputs by name; of the first view for a single-view model."""
    if isinstance(predictor, SingleViewPredictor):
        carm, path = posed.views[0].carm, posed.views[0].path_mm
        picture = net_picture(carm, path, int(predictor.model.inputs["pixels"]))
        arrays = [picture.network_input(), picture.axes_input()]
        return dict(zip(predictor.input_names(), arrays, strict=False))
    return dict(zip(input_names(), flat_inputs(posed.encoded), strict=True))


def table(rows: Sequence[Row], costs: Sequence[Cost], protocol: str) -> str:
    """Markdown: mean and SD over trees, the lowest and highest, then the cost."""
    out = [
        f"| {protocol}: predictor | centres near the vessel % | centreline near a centre % "
        "| lowest .. highest | centres | depth off by, pixels |",
        "|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(row.name for row in rows):
        own = [r for r in rows if r.name == name]
        p, r = (100 * np.array([getattr(x, k) for x in own]) for k in ("precision", "recall"))
        spread = 1 if len(own) > 1 else 0
        out.append(
            f"| {name} (n={len(own)}) | {p.mean():.1f} ± {p.std(ddof=spread):.1f} "
            f"| {r.mean():.1f} ± {r.std(ddof=spread):.1f} "
            f"| {p.min():.1f} .. {p.max():.1f} / {r.min():.1f} .. {r.max():.1f} "
            f"| {np.mean([x.centers for x in own]):.0f} | {_mean_depth(own)} |"
        )
    if costs:
        out += [
            "",
            "| inference of both views | itk-rtk pairs | pairs of CPU time | s | one pair, s "
            "| peak memory MiB |",
            "|---|---|---|---|---|---|",
        ]
        out += [
            f"| {c.name} | {c.pairs:.2f} | {c.cpu_pairs:.2f} | {c.seconds:.3f} "
            f"| {c.pair_seconds:.3f} | {c.peak_mib:.0f} |"
            for c in costs
        ]
    return "\n".join(out)


def _mean_depth(rows: Sequence[Row]) -> str:
    known = [row.depth_px for row in rows if row.depth_px is not None]
    if not known:
        return "-"
    return f"{np.mean(known):.1f} ({min(known):.1f} .. {max(known):.1f})"
