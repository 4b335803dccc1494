"""Options from vessel pictures to predicted centres."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Literal, TypeAlias, get_args

from gcar_deploy.config.ranges import Range, Scale, Share, Size

Predictor: TypeAlias = Literal["auto", "multi", "single", "none"]
PREDICTORS = get_args(Predictor)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelLimits:
    """What a model file may be before ONNX Runtime sees it."""

    max_bytes: Size = 64 * 2**20
    #: of the spec beside it, and of the golden input and output
    max_spec_bytes: Size = 64 * 2**10
    max_golden_bytes: Size = 8 * 2**20
    max_nodes: Size = 20_000
    #: fields of the file in all (a node has some ten)
    max_fields: Size = 1_000_000
    #: weights and constants in all
    max_elements: Size = 2**25
    max_opset: Size = 30
    #: largest relative and absolute difference from the golden output
    golden_rtol: Annotated[float, Range(0, 1000)] = 1e-3
    golden_atol: Annotated[float, Range(0, 1000)] = 1e-4


@dataclasses.dataclass(frozen=True, kw_only=True)
class CandidateOptions:
    """The sparse set of points that every view sees as vessel."""

    #: a lattice point is kept where each view's path exceeds this share of a cell's edge; lower
    #: keeps more of the rim of thin vessels, higher gives the predictor fewer points to judge
    min_path_cells: Annotated[float, Range(0, 100)] = 0.5
    #: passes of the thinning that stands in for a model
    thinning_steps: Annotated[int, Range(0, 10000)] = 40
    #: power applied after each pass; above 1 weak shares give way to strong ones
    thinning_sharpness: Annotated[float, Range(0.1, 100)] = 1.05


@dataclasses.dataclass(frozen=True, kw_only=True)
class DecideOptions:
    """From confidences to a decision (see ``predict/decision.py``)."""

    steps: Annotated[int, Range(1, 10000)] = 24
    #: inverse temperature reached at the last step
    final_sharpness: Annotated[float, Range(1e-3, 1000)] = 3.0
    #: weight of a vessel neighbour, and how many of the 26 are support enough
    coupling: Annotated[float, Range(0, 1000)] = 1.0
    enough_neighbours: Annotated[float, Range(1e-3, 1000)] = 3.0
    #: how freely a ray may differ from its path length, cells squared per unit of evidence
    looseness: Scale = 0.5
    #: ... and more by this times the square of the paths' relative error
    looseness_of_error: Annotated[float, Range(0, 1e6)] = 56.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class SingleViewOptions:
    """How the centres that single views predict become one set (``predict/single_view.py``)."""

    #: a depth off by so many pixel edges of the network's picture counts a quarter; the shipped
    #: model is off by some 9 (median, generated scenes)
    depth_scale_pixels: Scale = 8.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class PredictOptions:
    """Which Gaussian centre predictor to use, and how."""

    #: ``auto``: the shipped multi-view model, or the kind of the one given; ``none``: the visual
    #: hull is thinned
    predictor: Predictor = "auto"
    #: lattices on which the multi-view predictor judges the scene, each shifted against the others;
    #: after the first only what lies near points of at least this confidence is asked again
    looks: Annotated[int, Range(1, 4)] = 2
    look_again: Share = 0.15
    #: edge of the lattice the predictor works on: the grid's own within these bounds, mm; thin
    #: vessels get finer cells down to ``thin_cell_mm`` where the predictor knows such cells
    min_cell_mm: Annotated[float, Range(0.3, 10)] = 0.85
    max_cell_mm: Annotated[float, Range(0.3, 10)] = 1.5
    thin_cell_mm: Annotated[float, Range(0.2, 10)] = 0.3
    limits: ModelLimits = dataclasses.field(default_factory=ModelLimits)
    single: SingleViewOptions = dataclasses.field(default_factory=SingleViewOptions)
