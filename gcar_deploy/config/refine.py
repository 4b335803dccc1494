"""Options from centres to tree, tubes, Gaussians and voxels."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Literal, TypeAlias, get_args

from gcar_deploy.config.ranges import Count, Range, Share

RefinerName: TypeAlias = Literal["tube", "paper", "none"]
REFINERS = get_args(RefinerName)
Backend: TypeAlias = Literal["numpy", "numba", "torch"]
BACKENDS = get_args(Backend)
Device: TypeAlias = Literal["cpu", "cuda"]
DEVICES = get_args(Device)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TubeOptions:
    """The default refiner: tubes fitted to the pictures by Gauss-Newton."""

    #: working pixel at the isocentre per level, coarse to fine; 0 is the picture's own, mm
    levels_mm: Annotated[tuple[float, ...], Range(0, 100, many=1)] = (1.0, 0.0)
    #: most Gauss-Newton steps per level
    steps: Annotated[tuple[int, ...], Range(0, 10_000, many=1)] = (6, 5)
    #: noise of the path length: constant part, and share of the path, per mm^2 of picture; the
    #: share is the picture's own (``VesselImage.path_error``) where that is larger
    noise_mm: Annotated[float, Range(1e-3, 1e3)] = 0.4
    noise_share: Annotated[float, Range(0, 100)] = 0.05
    #: residuals beyond this many sigma lose weight (Cauchy)
    robust_sigmas: Annotated[float, Range(1e-3, 1e6)] = 2.0
    #: centreline: random walk of the direction, 1 / sqrt(mm)
    bend: Annotated[float, Range(1e-6, 1e9)] = 0.15
    #: radius: random walk of its log, 1 / sqrt(mm)
    taper: Annotated[float, Range(1e-6, 1e9)] = 0.1
    #: steps that refit the radii with the axes held, on fine pixels
    radius_refit_steps: Annotated[int, Range(0, 10000)] = 3
    #: starting points: standard deviation over 1 mm of centreline, mm
    anchor_mm: Annotated[float, Range(1e-3, 1e6)] = 1.0
    #: starting radii: standard deviation of the log over 1 mm of centreline
    anchor_log_radius: Annotated[float, Range(1e-3, 1e6)] = 0.5
    #: blur of vessel edges that is not the pixel's own (motion, focal spot), box width, mm
    edge_blur_mm: Annotated[float, Range(0, 100)] = 0.5
    #: share of the pictures' weight that goes to their centreline alone (the paper's 1 - alpha)
    centreline_share: Share = 0.0

    def contradiction(self) -> str:
        """Say which fields do not fit together; empty where all do."""
        fits = len(self.levels_mm) == len(self.steps)
        return "" if fits else "steps must be as many as levels_mm"


@dataclasses.dataclass(frozen=True, kw_only=True)
class PaperOptions:
    """The paper's refinement: Gaussians, Adam, adaptive density control."""

    #: weight of the plain projection loss; the centreline loss has the rest (the paper's 0.5)
    alpha: Share = 0.5
    steps: Count = 150
    #: pictures are sampled to this pixel at the isocentre (the paper's 128^2), mm
    pixel_mm: Annotated[float, Range(0.05, 50)] = 1.0
    #: learning rates: mm, log scale through its sigmoid, quaternion, softplus intensity
    rate_mean_mm: Annotated[float, Range(0, 10)] = 0.05
    rate_scale: Annotated[float, Range(0, 10)] = 0.05
    rate_rotation: Annotated[float, Range(0, 10)] = 0.02
    rate_intensity: Annotated[float, Range(0, 10)] = 0.05
    #: rates fall to this share of themselves over the steps
    final_rate: Annotated[float, Range(1e-6, 1)] = 0.2
    #: start: points at least so confident, and the cap that always holds
    least_confidence: Share = 0.3
    most_gaussians: Annotated[int, Range(1, 1000000)] = 10_000
    #: points nearer than this to a more confident one share its Gaussian, cells; 0 keeps all.
    #: 1.1 halves Gaussians and time, and costs accuracy where the points are good
    thin_cells: Annotated[float, Range(0, 100)] = 0.0
    #: density control: steps between, pull against the mean pull, size that splits, mass that goes
    control_every: Count = 40
    pull_ratio: Annotated[float, Range(0, 1e6)] = 4.0
    split_pixels: Annotated[float, Range(0, 1e6)] = 1.5
    least_mass_share: Share = 0.02
    #: stop when the best of so many steps is not better
    patience: Annotated[int, Range(1, 1_000_000)] = 20
    #: what projects: NumPy, compiled loops, or the reference twin
    backend: Backend = "numpy"
    device: Device = "cpu"


#: as printed: density control that may add to 10,000 Gaussians, up to 8,000 iterations; what is not
#: printed is as in ``PaperOptions`` but for the pull that clones, chosen on a generated tree
PRINTED = PaperOptions(
    steps=8_000, control_every=100, pull_ratio=1.5, patience=8_000, most_gaussians=12_000,
    least_confidence=0.0,
)  # fmt: skip
#: as in the code that was released: plain L2, rates of 1.6e-4 of the cube's 180 mm (falling to 0.29
#: of it), 0.005 (log scale), 0.001 (rotation) and 0.01 (intensity)
RELEASED = dataclasses.replace(
    PRINTED, alpha=1.0, rate_mean_mm=0.029, rate_scale=0.005, rate_rotation=0.001,
    rate_intensity=0.01, final_rate=0.29, patience=600,
)  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class RefineOptions:
    """How the points become vessels: which refiner does it, and what each may."""

    refiner: RefinerName = "tube"
    tube: TubeOptions = dataclasses.field(default_factory=TubeOptions)
    paper: PaperOptions = dataclasses.field(default_factory=PaperOptions)
    #: correct the tubes' occupancy by pictures and starting points; else round tubes only
    fuse: bool = True
