"""Settings of every row of the tables, in one frozen value, and what a row depends on."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Mapping
from typing import Any

from gcar_deploy.config import (
    PRINTED,
    RELEASED,
    Backend,
    PaperOptions,
    PredictorName,
    RefinerName,
    RunOptions,
    SegmenterName,
)
from gcar_deploy.errors import UsageError
from gcar_export.methods.fdk import FdkOptions
from gcar_export.methods.nerp import NerpOptions
from gcar_export.methods.own_models import OwnModels, sha256
from gcar_export.methods.sart import SartOptions
from gcar_export.methods.visual_hull import PATH_THRESHOLD_MM


@dataclasses.dataclass(frozen=True, kw_only=True)
class RuntimeRow:
    """A row that goes through the runtime's own ``Engine``.

    Attributes
    ----------
    predictor, refiner : of ``RunOptions``; None for what the runtime does unasked
    printed : the paper's refinement as printed (``config.PRINTED``) in place of a short budget
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
    printed: bool = False
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
    "3dgr-gcp": RuntimeRow(predictor="paper", refiner="paper", printed=True),
    "3dgr-gcp-l2": RuntimeRow(
        predictor="paper", refiner="paper", printed=True, centreline_loss=False
    ),
    "3dgr-gcp-short": RuntimeRow(predictor="paper", refiner="paper"),
    "multi": RuntimeRow(predictor="multi", refiner="none"),
    "multi+paper": RuntimeRow(predictor="multi", refiner="paper"),
    "multi+tube": RuntimeRow(predictor="multi", refiner="tube"),
}  # fmt: skip
#: rows that know nothing of the runtime but its geometry.
BASELINES = ("fdk", "sart", "visual_hull", "nerp")
#: centres at true depth, an upper bound for a predictor of single views.
TRUE_DEPTH = "3dgr-true-depth"
#: the paper's refinement from other starts, FBP ("3DGR-FBP") or true depth, and its settings.
START_ROWS: Mapping[str, PaperOptions] = {
    "3dgr-fbp": PRINTED,
    "3dgr-fbp-l2": dataclasses.replace(PRINTED, alpha=1.0),
    "3dgr-fbp-released": RELEASED,
    TRUE_DEPTH: PRINTED,
    "3dgr-fbp-short": dataclasses.replace(PRINTED, steps=PaperOptions().steps),
}
METHODS = (*RUNTIME_ROWS, *START_ROWS, *BASELINES)
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
    "hull+paper": "hull thinned, the paper's refinement, short budget",
    "hull+tube": "hull thinned, tube refinement",
    "3dgr-gcp": "3DGR-GCP (as printed): the paper's predictor, its refinement",
    "3dgr-gcp-l2": "3DGR-GCP (as printed), L2 alone",
    "3dgr-gcp-short": "3DGR-GCP, short budget (150 iterations)",
    "multi": "multi-view predictor alone",
    "multi+paper": "multi-view predictor, the paper's refinement, short budget",
    "multi+tube": "multi-view predictor, tube refinement (what gcar does)",
    "3dgr-fbp": "3DGR-FBP (as printed): FDK start, the paper's refinement",
    "3dgr-fbp-l2": "3DGR-FBP (as printed), L2 alone",
    "3dgr-fbp-released": "3DGR-FBP with the settings of the released code",
    TRUE_DEPTH: "the same from centres at true depth: what a perfect predictor would give",
    "3dgr-fbp-short": "3DGR-FBP, short budget (150 iterations)",
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
    fbp_gaussians : Gaussians that 3DGR-FBP starts with (the released code's number)
    paper_steps : most steps of the paper's refinement in all rows that use it; None for those of
        the row
    backend : what projects Gaussians in these rows; numba is ten times as fast as NumPy
    run : the runtime's options
    own : models in place of those that come along
    """

    fdk: FdkOptions = dataclasses.field(default_factory=FdkOptions)
    sart: SartOptions = dataclasses.field(default_factory=SartOptions)
    nerp: NerpOptions = dataclasses.field(default_factory=NerpOptions)
    hull_path_mm: float = PATH_THRESHOLD_MM
    fbp_gaussians: int = 10_000
    paper_steps: int | None = None
    backend: Backend = "numba"
    run: RunOptions = dataclasses.field(default_factory=RunOptions)
    own: OwnModels = dataclasses.field(default_factory=OwnModels)

    def __post_init__(self) -> None:
        if self.paper_steps is not None and not 1 <= self.paper_steps <= 100_000:
            raise UsageError(f"paper-steps = {self.paper_steps} is outside 1 .. 100000")

    def run_options(self, method: str) -> RunOptions:
        """Return the runtime's options for a method of ``RUNTIME_ROWS``."""
        row, run = RUNTIME_ROWS[method], self.run
        paper = self._limited(PRINTED if row.printed else run.refine.paper)
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

    def own_models(self, method: str) -> OwnModels:
        """Return those of ``own`` that a method asks; none but rows of the runtime asks any."""
        if method not in RUNTIME_ROWS:
            return OwnModels()
        return self.own.used(self.run_options(method))

    def started_options(self, method: str) -> PaperOptions:
        """Return the paper's refinement for a method of ``START_ROWS``."""
        return self._limited(START_ROWS[method])

    def _limited(self, paper: PaperOptions) -> PaperOptions:
        steps = min(paper.steps, self.paper_steps or paper.steps)
        return dataclasses.replace(paper, steps=steps, backend=self.backend)

    def of(self, method: str) -> dict[str, Any]:
        """Everything that the result of ``method`` depends on, as plain values."""
        if method in RUNTIME_ROWS:
            options, own = self.run_options(method), self.own_models(method)
            shipped = {} if own.predictor else _shipped(options.predict.predictor)
            out = {
                "run": {k: v for k, v in dataclasses.asdict(options).items() if k in _STAGES},
                "swapped": RUNTIME_ROWS[method].swapped,
                "grey_masks": RUNTIME_ROWS[method].grey_masks,
                "models": shipped | {path.name: sha256(path) for path in own.files},
            }
        elif method in START_ROWS:
            out = {
                "fdk": dataclasses.asdict(self.fdk),
                "gaussians": self.fbp_gaussians,
                "paper": dataclasses.asdict(self.started_options(method)),
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
def _shipped(predictor: str) -> dict[str, str]:
    """SHA-256 of the shipped models that a predictor may use, by file name."""
    from gcar_deploy.predict.kinds import PREDICTOR_KINDS

    kinds = {"auto": ("multi",), "none": ()}.get(predictor, (predictor,))
    paths = [PREDICTOR_KINDS[kind].path for kind in kinds]
    return {p.name: sha256(p) for p in paths if p is not None}
