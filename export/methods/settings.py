"""Settings of every row of the tables, in one frozen value, and what a row depends on."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gcar_deploy.config import PaperOptions, PredictorName, RefinerName, RunOptions, SegmenterName
from gcar_deploy.errors import UsageError
from gcar_export.methods.fdk import FdkOptions
from gcar_export.methods.nerp import NerpOptions
from gcar_export.methods.sart import SartOptions
from gcar_export.methods.visual_hull import PATH_THRESHOLD_MM


@dataclasses.dataclass(frozen=True, kw_only=True)
class RuntimeRow:
    """A row that goes through the runtime's own ``Engine``.

    Attributes
    ----------
    predictor, refiner : of ``RunOptions``; None for what the runtime does unasked
    centreline_loss : False turns the paper's centreline term off (alpha = 1)
    swapped : the views are given in the other order
    pose : False leaves the views where the scene puts them
    segmenter : who finds vessels in raw pictures; None for what the runtime does unasked
    fused : False leaves the tubes round: no correction of the volume by pictures and points
    lattices : asked of the predictor; None for what the runtime does unasked
    coarse : True leaves the cells as wide as the volume's voxels, however thin the vessels
    grey_masks : True gives masks as raw grey pictures, whose brightness is believed
    """

    predictor: PredictorName | None = None
    refiner: RefinerName | None = None
    centreline_loss: bool = True
    swapped: bool = False
    pose: bool = True
    fused: bool = True
    lattices: int | None = None
    coarse: bool = False
    grey_masks: bool = False
    segmenter: SegmenterName | None = None


#: what the runtime does when asked for nothing in particular.
OURS = "ours"
RUNTIME_ROWS: Mapping[str, RuntimeRow] = {
    OURS: RuntimeRow(),
    "ours-swapped": RuntimeRow(swapped=True),
    "ours-nopose": RuntimeRow(pose=False),
    "ours-round": RuntimeRow(fused=False),
    "ours-onelattice": RuntimeRow(lattices=1),
    "ours-coarse": RuntimeRow(coarse=True),
    "ours-greymask": RuntimeRow(grey_masks=True),
    "ours-classic": RuntimeRow(segmenter="classic"),
    "ours-net": RuntimeRow(segmenter="net"),
    "hull": RuntimeRow(predictor="none", refiner="none"),
    "hull+paper": RuntimeRow(predictor="none", refiner="paper"),
    "hull+tube": RuntimeRow(predictor="none", refiner="tube"),
    "single": RuntimeRow(predictor="single", refiner="none"),
    "single+paper": RuntimeRow(predictor="single", refiner="paper"),
    "single+paper-noloss": RuntimeRow(
        predictor="single", refiner="paper", centreline_loss=False
    ),
    "single+tube": RuntimeRow(predictor="single", refiner="tube"),
    "multi": RuntimeRow(predictor="multi", refiner="none"),
    "multi+paper": RuntimeRow(predictor="multi", refiner="paper"),
    "multi+tube": RuntimeRow(predictor="multi", refiner="tube"),
}  # fmt: skip
#: rows that know nothing of the runtime but its geometry.
BASELINES = ("fdk", "sart", "visual_hull", "nerp")
#: the paper's refinement from an FBP start ("3DGR-FBP").
FBP_PAPER = "fbp+paper"
METHODS = (*RUNTIME_ROWS, FBP_PAPER, *BASELINES)
#: options of the runtime that a simulated case depends on (not: how files are read).
_STAGES = (
    "imaging", "pose", "candidates", "predict", "refine", "quality",
)  # fmt: skip
#: method -> one line for tables and reports.
DESCRIPTIONS: Mapping[str, str] = {
    OURS: "gcar as it comes: multi-view predictor, tube refinement",
    "ours-swapped": "the same, views given in the other order",
    "ours-nopose": "the same without the estimate of shifts between the views",
    "ours-round": "the same with round tubes alone in the volume",
    "ours-onelattice": "the same, the predictor asked on one lattice",
    "ours-coarse": "the same, cells no finer than the volume's voxels",
    "ours-greymask": "the same, masks taken for grey pictures",
    "ours-classic": "the same, vessels of raw pictures found without the network",
    "ours-net": "the same, vessels of raw pictures found by the network alone",
    "hull": "hull thinned: no model, no refinement",
    "hull+paper": "hull thinned, the paper's refinement",
    "hull+tube": "hull thinned, tube refinement",
    "single": "single-view predictor alone",
    "single+paper": "the paper's method (3DGR-GCP): single-view predictor, its refinement",
    "single+paper-noloss": "the same without the centreline loss",
    "single+tube": "single-view predictor, tube refinement",
    "multi": "multi-view predictor alone",
    "multi+paper": "multi-view predictor, the paper's refinement",
    "multi+tube": "multi-view predictor, tube refinement (what gcar does)",
    FBP_PAPER: "3DGR-FBP: FDK start, the paper's refinement",
    "fdk": "filtered backprojection (FDK, itk-rtk)",
    "sart": "SART, non-negative (itk-rtk)",
    "visual_hull": "visual hull",
    "nerp": "implicit network (NeRP) fitted to the views",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class MethodSettings:
    """Settings of all rows.

    Attributes
    ----------
    fdk, sart, nerp : of the baselines of these names
    hull_path_mm : a pixel is vessel for ``visual_hull`` from this path length on
    fbp_gaussians : Gaussians that ``fbp+paper`` starts with (the paper's number)
    fbp_steps : steps of ``fbp+paper``: a reduced budget, for two cores
    paper_steps : steps of the paper's refinement in all rows that use it; None for the
        defaults (``PaperOptions.steps``, ``fbp_steps``)
    run : the runtime's options
    """

    fdk: FdkOptions = dataclasses.field(default_factory=FdkOptions)
    sart: SartOptions = dataclasses.field(default_factory=SartOptions)
    nerp: NerpOptions = dataclasses.field(default_factory=NerpOptions)
    hull_path_mm: float = PATH_THRESHOLD_MM
    fbp_gaussians: int = 10_000
    fbp_steps: int = 150
    paper_steps: int | None = None
    run: RunOptions = dataclasses.field(default_factory=RunOptions)

    def __post_init__(self) -> None:
        if self.paper_steps is not None and not 1 <= self.paper_steps <= 100_000:
            raise UsageError(f"paper-steps = {self.paper_steps} is outside 1 .. 100000")

    def run_options(self, method: str) -> RunOptions:
        """Return the runtime's options for a method of ``RUNTIME_ROWS``."""
        row, run = RUNTIME_ROWS[method], self.run
        paper = run.refine.paper
        if self.paper_steps is not None:
            paper = dataclasses.replace(paper, steps=self.paper_steps)
        if not row.centreline_loss:
            paper = dataclasses.replace(paper, alpha=1.0)
        return dataclasses.replace(
            run,
            imaging=dataclasses.replace(
                run.imaging, segmenter=row.segmenter or run.imaging.segmenter
            ),
            pose=dataclasses.replace(run.pose, enabled=run.pose.enabled and row.pose),
            predict=dataclasses.replace(
                run.predict,
                predictor=row.predictor or run.predict.predictor,
                lattices=row.lattices or run.predict.lattices,
                thin_cell_mm=(run.predict.min_cell_mm if row.coarse else run.predict.thin_cell_mm),
            ),
            refine=dataclasses.replace(
                run.refine,
                refiner=row.refiner or run.refine.refiner,
                paper=paper,
                fuse=run.refine.fuse and row.fused,
            ),
        )

    def fbp_paper_options(self) -> PaperOptions:
        """Return the paper's refinement from an FBP start: all its points, weak ones too."""
        return dataclasses.replace(
            self.run.refine.paper,
            steps=self.paper_steps or self.fbp_steps,
            most_gaussians=max(self.run.refine.paper.most_gaussians, self.fbp_gaussians),
            least_confidence=0.0,
            thin_cells=0.0,
        )

    def of(self, method: str) -> dict[str, Any]:
        """Everything that the result of ``method`` depends on, as plain values."""
        if method in RUNTIME_ROWS:
            options = self.run_options(method)
            out = {
                "run": {k: v for k, v in dataclasses.asdict(options).items() if k in _STAGES},
                "swapped": RUNTIME_ROWS[method].swapped,
                "grey_masks": RUNTIME_ROWS[method].grey_masks,
                "models": _model_hashes(options.predict.predictor),
            }
        elif method == FBP_PAPER:
            out = {
                "fdk": dataclasses.asdict(self.fdk),
                "gaussians": self.fbp_gaussians,
                "paper": dataclasses.asdict(self.fbp_paper_options()),
            }
        elif method == "visual_hull":
            out = {"path_mm": self.hull_path_mm}
        else:
            out = dataclasses.asdict(getattr(self, method))
        return out

    def digest(self, method: str) -> str:
        """First 16 hexadecimal digits of the SHA-256 of ``of(method)``."""
        text = json.dumps(self.of(method), sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@functools.cache
def _model_hashes(predictor: str) -> dict[str, str]:
    """SHA-256 of the shipped models that a predictor may use, by file name."""
    from gcar_deploy.predict.kinds import PREDICTORS

    kinds = {"auto": ("multi",), "none": ()}.get(predictor, (predictor,))
    paths = [PREDICTORS[kind].path for kind in kinds]
    return {p.name: _sha256(p) for p in paths if p is not None}


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
