"""Options from vessel pictures to predicted centres."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Literal, TypeAlias, get_args

from gcar_deploy.config.ranges import Range, Size

PredictorName: TypeAlias = Literal["auto", "multi", "paper", "none"]
PREDICTORS = get_args(PredictorName)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelLimits:
    """What a model file may be before ONNX Runtime sees it."""

    max_bytes: Size = 64 * 2**20
    #: of the golden input and output beside it
    max_golden_bytes: Size = 8 * 2**20
    max_nodes: Size = 20_000
    #: fields of the file in all (a node has some ten)
    max_fields: Size = 1_000_000
    #: weights and constants in all
    max_elements: Size = 2**25
    max_opset: Size = 30


@dataclasses.dataclass(frozen=True, kw_only=True)
class CandidateOptions:
    """The sparse set of points that every view sees as vessel."""

    #: a lattice point is kept where each view's path exceeds this share of a cell's edge; lower
    #: keeps more of the rim of thin vessels, higher gives the predictor fewer points to judge
    min_path_cells: Annotated[float, Range(0, 100)] = 0.5


@dataclasses.dataclass(frozen=True, kw_only=True)
class PredictOptions:
    """Which Gaussian centre predictor to use, and how."""

    #: ``auto``: the shipped multi-view model, or the kind of the one given; ``none``: the visual
    #: hull is thinned
    predictor: PredictorName = "auto"
    #: lattices on which the multi-view predictor judges the scene, each shifted against the others
    lattices: Annotated[int, Range(1, 4)] = 2
    #: edge of the lattice the predictor works on: the grid's own within these bounds, mm; thin
    #: vessels get finer cells down to ``thin_cell_mm`` where the predictor knows such cells
    min_cell_mm: Annotated[float, Range(0.3, 10)] = 0.85
    max_cell_mm: Annotated[float, Range(0.3, 10)] = 1.5
    thin_cell_mm: Annotated[float, Range(0.2, 10)] = 0.3
    limits: ModelLimits = dataclasses.field(default_factory=ModelLimits)
