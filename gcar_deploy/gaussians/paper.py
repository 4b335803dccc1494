"""The paper's refinement: anisotropic Gaussians, Adam, adaptive density control.

The reference row of every comparison. What the paper leaves open is settled for safety: scales
are bounded by a sigmoid between a quarter pixel and 10 mm, intensities by a softplus, a step
that leaves the finite numbers is rejected and counted, and five in a row end the run.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import expit, logit

from gcar_deploy.config import PaperOptions
from gcar_deploy.gaussians.adam import Adam
from gcar_deploy.gaussians.backends import Backend, backend_named
from gcar_deploy.gaussians.centers import CenterPoints
from gcar_deploy.gaussians.density_control import clone, most_wanting, prune, split
from gcar_deploy.gaussians.gaussians import TWO_PI_3_2, Gaussians
from gcar_deploy.gaussians.loss import projection_loss
from gcar_deploy.gaussians.project import Gradient
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.resample import sampled
from gcar_deploy.types import Array, Points

Progress = Callable[[float], None]
MOST_REJECTED = 5
#: sigma of a Gaussian at its start, cells
INITIAL_SIGMA_CELLS = 0.55
#: bounds of the standard deviations: pixels, mm
LEAST_SIGMA_PIXELS, LARGEST_SIGMA_MM = 0.25, 10.0
#: end where the best of ``patience`` steps is not better by this share
TOLERANCE = 2e-3
#: a Gaussian is at most so many times as long as it is wide
MOST_ANISOTROPY = 20.0
#: bounds of the contrast of a picture that is not calibrated
CONTRAST_BOUNDS = (0.4, 2.5)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PaperResult:
    """What the refinement ends with.

    Attributes
    ----------
    gaussians : Gaussians
    losses : loss before each step, mm^2
    steps, rejected_steps : int
    status : ``ok``, ``stopped`` (by the caller) or ``failed`` (numbers not finite)
    contrast : per view, factor of the picture's path on the model's, 1 where calibrated
    """

    gaussians: Gaussians
    losses: tuple[float, ...]
    steps: int
    rejected_steps: int
    status: str
    contrast: tuple[float, ...]


def initial_gaussians(centers: CenterPoints, options: PaperOptions) -> Gaussians:
    """Place as few isotropic Gaussians as the points need, and never more than the cap.

    Points closer than ``thin_cells`` to a more confident one join the nearest that stays. Each
    Gaussian takes the mass (confidence times spacing^3 of each), the centre and the spread of
    its points, to which a single point's own ``INITIAL_SIGMA_CELLS`` are added.
    """
    # Centres of single views are all used: none was judged against another.
    least = 0.0 if centers.source == "paper" else options.least_confidence
    used = centers.select(centers.confidence >= least)
    h = used.spacing_mm
    order = np.argsort(-used.confidence, kind="stable")
    if options.thin_cells > 0:
        used = used.select(order)
        head = _heads(used.points_mm, options.thin_cells * h)[: options.most_gaussians]
        nearest = cKDTree(used.points_mm[head]).query(used.points_mm)[1] if len(head) else head
    else:
        used = used.select(np.sort(order[: options.most_gaussians]))
        head = nearest = np.arange(len(used))
    n = len(head)
    share = np.maximum(used.confidence, 1e-6)
    weight = np.bincount(nearest, share, minlength=n)
    sums = [np.bincount(nearest, share * x, minlength=n) for x in used.points_mm.T]
    mean: Array = np.stack(sums, axis=1) / weight[:, None]
    apart = np.sum((used.points_mm - mean[nearest]) ** 2, axis=1) / 3.0
    spread = np.bincount(nearest, share * apart, minlength=n) / weight
    sigma = np.sqrt(spread + (INITIAL_SIGMA_CELLS * h) ** 2)
    return Gaussians(
        means_mm=mean,
        scales_mm=np.repeat(sigma[:, None], 3, axis=1),
        quaternions_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        intensity=weight * h**3 / (TWO_PI_3_2 * sigma**3),
    )


def _heads(points: Points, distance_mm: float) -> Array:
    """Pick points in order, none within ``distance_mm`` of one picked before."""
    if distance_mm <= 0 or not len(points):
        return np.arange(len(points))
    free = np.ones(len(points), bool)
    head = []
    for i, near in enumerate(cKDTree(points).query_ball_point(points, distance_mm)):
        if free[i]:
            head.append(i)
            free[near] = False
    return np.asarray(head, dtype=np.int64)


def refine_paper(
    start: CenterPoints | Gaussians,
    views: Sequence[VesselImage],
    options: PaperOptions,
    *,
    on_progress: Progress | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> PaperResult:
    """Fit Gaussians to the path lengths of all views.

    Parameters
    ----------
    start : points to place Gaussians on, or Gaussians to go on from
    views : vessel images; sampled to ``options.pixel_mm`` at the isocentre
    options : PaperOptions
    on_progress : called with the share of the steps done
    should_stop : asked before every step
    """
    gaussians = start if isinstance(start, Gaussians) else initial_gaussians(start, options)
    if len(gaussians) > options.most_gaussians:
        heavy = np.argsort(-gaussians.masses_mm3(), kind="stable")[: options.most_gaussians]
        gaussians = gaussians.select(np.sort(heavy))
    backend = backend_named(options.backend, options.device)
    views = [sampled(view, options.pixel_mm) for view in views]
    finest = min(view.carm.pixel_at_isocenter_mm for view in views)
    scaling = _Scaling(LEAST_SIGMA_PIXELS * finest, LARGEST_SIGMA_MM)
    free, adam = _capped(_freed(gaussians, scaling), scaling), _adam(options)
    losses: list[float] = []
    rejected = in_a_row = 0
    gaussians = _bound(free, scaling)
    best, status, step = (np.inf, gaussians, (1.0,) * len(views)), "ok", 0
    for step in range(options.steps):
        if should_stop is not None and should_stop():
            status = "stopped"
            break
        gaussians = _bound(free, scaling)
        loss, gradient, contrast = _loss(gaussians, views, options, backend)
        moves = adam.step(_to_free(gradient, free, scaling), _cooling(step, options))
        if not (np.isfinite(loss) and all(np.isfinite(m).all() for m in moves.values())):
            rejected, in_a_row = rejected + 1, in_a_row + 1
            free = _freed(best[1], scaling)
            adam.restart()
            if in_a_row >= MOST_REJECTED:
                status = "failed"
                break
            continue
        in_a_row = 0
        losses.append(loss)
        if loss < best[0]:
            best = (loss, gaussians, contrast)
        if _no_progress(losses, options):
            break
        free = _capped({name: value + moves[name] for name, value in free.items()}, scaling)
        if options.control_every and step and step % options.control_every == 0:
            free = _controlled(free, gradient, scaling, options, finest)
            adam.restart()
        if on_progress is not None:
            on_progress((step + 1) / options.steps)
    return PaperResult(
        gaussians=best[1],
        losses=tuple(losses),
        steps=len(losses),
        rejected_steps=rejected,
        status=status,
        contrast=best[2],
    )


@dataclasses.dataclass(frozen=True)
class _Scaling:
    """Log scales between two bounds, through a sigmoid."""

    least_mm: float
    largest_mm: float

    def free(self, scales_mm: Array) -> Array:
        share = np.log(scales_mm / self.least_mm) / np.log(self.largest_mm / self.least_mm)
        return np.asarray(logit(np.clip(share, 0.02, 0.98)))

    def bound(self, free: Array) -> Array:
        span = np.log(self.largest_mm / self.least_mm)
        return np.asarray(self.least_mm * np.exp(span * expit(free)))

    def slope(self, free: Array) -> Array:
        """Return the derivative of the log scale by the free parameter."""
        s = expit(free)
        return np.asarray(np.log(self.largest_mm / self.least_mm) * s * (1 - s))


def _freed(g: Gaussians, scaling: _Scaling) -> dict[str, Array]:
    intensity = np.clip(g.intensity, 1e-4, 1e4)
    return {
        "means": g.means_mm,
        "scales": scaling.free(g.scales_mm),
        "quaternions": g.quaternions_wxyz,
        # Inverse of the softplus, in the form that keeps small and large values.
        "intensity": intensity + np.log(-np.expm1(-intensity)),
    }


def _bound(free: dict[str, Array], scaling: _Scaling) -> Gaussians:
    return Gaussians(
        means_mm=free["means"],
        scales_mm=scaling.bound(free["scales"]),
        quaternions_wxyz=free["quaternions"],
        intensity=np.logaddexp(0.0, free["intensity"]),
    )


def _capped(free: dict[str, Array], scaling: _Scaling) -> dict[str, Array]:
    """Thicken Gaussians longer than ``MOST_ANISOTROPY`` times their width; masses are kept."""
    scales = scaling.bound(free["scales"])
    least = scales.max(axis=1, initial=0.0, keepdims=True) / MOST_ANISOTROPY
    thin = (scales < least).any(axis=1)
    if not thin.any():
        return free
    g = _bound(free, scaling)
    wide = np.maximum(scales, least)
    shrink = np.prod(scales / wide, axis=1)
    changed = _freed(
        dataclasses.replace(g, scales_mm=wide, intensity=g.intensity * shrink), scaling
    )
    return {
        name: np.where(thin.reshape((-1,) + (1,) * (value.ndim - 1)), changed[name], value)
        for name, value in free.items()
    }


def _to_free(g: Gradient, free: dict[str, Array], scaling: _Scaling) -> dict[str, Array]:
    return {
        "means": g.means_mm,
        "scales": g.log_scales * scaling.slope(free["scales"]),
        "quaternions": g.quaternions_wxyz,
        "intensity": g.intensity * expit(free["intensity"]),
    }


def _adam(options: PaperOptions) -> Adam:
    return Adam(
        {
            "means": options.rate_mean_mm,
            "scales": options.rate_scale,
            "quaternions": options.rate_rotation,
            "intensity": options.rate_intensity,
        }
    )


def _cooling(step: int, options: PaperOptions) -> float:
    """Exponential decay of all rates to ``final_rate`` of their start."""
    return float(options.final_rate ** (step / max(options.steps - 1, 1)))


def _loss(
    g: Gaussians, views: Sequence[VesselImage], options: PaperOptions, backend: Backend
) -> tuple[float, Gradient, tuple[float, ...]]:
    """Sum of the views' losses, its gradient, and the contrast of each view."""
    total, parts, contrast = 0.0, [], []
    for view in views:
        made = backend.project(g, view.carm)
        factor = 1.0 if view.calibrated else _contrast(made, view)
        loss, by_picture = projection_loss(
            factor * made, view.path_mm, view.skeleton, view.valid, options.alpha
        )
        total += loss
        parts.append(backend.vjp(g, view.carm, factor * by_picture))
        contrast.append(factor)
    names = [f.name for f in dataclasses.fields(Gradient)]
    summed = {name: np.sum([getattr(p, name) for p in parts], axis=0) for name in names}
    return total, Gradient(**summed), tuple(contrast)


def _contrast(made: Array, view: VesselImage) -> float:
    """Least-squares factor of a picture whose scale is unknown (variable projection)."""
    made = np.where(view.valid, made, 0.0)
    power = float(np.sum(made * made))
    factor = float(np.sum(made * view.path_mm)) / power if power > 0 else 1.0
    return float(np.clip(factor, *CONTRAST_BOUNDS))


def _no_progress(losses: Sequence[float], options: PaperOptions) -> bool:
    k = options.patience
    if len(losses) <= k:
        return False
    return min(losses[-k:]) > (1 - TOLERANCE) * min(losses[:-k])


def _controlled(
    free: dict[str, Array],
    gradient: Gradient,
    scaling: _Scaling,
    options: PaperOptions,
    pixel_mm: float,
) -> dict[str, Array]:
    """Clone small Gaussians that pull hard, split large ones, drop the light; keep the cap."""
    g = _bound(free, scaling)
    pull = np.linalg.norm(gradient.means_mm, axis=1)
    threshold = options.pull_ratio * float(np.mean(pull)) if len(pull) else 0.0
    wanting = most_wanting(pull, threshold, options.most_gaussians - len(g))
    large = g.scales_mm[wanting].max(axis=1, initial=0.0) > options.split_pixels * pixel_mm
    splitting, cloning = wanting[large], wanting[~large]
    # Splitting appends, so the indices of the others stay.
    g = clone(split(g, splitting), cloning, gradient.means_mm[cloning])
    mass = g.masses_mm3()
    least = options.least_mass_share * float(np.median(mass)) if len(mass) else 0.0
    return _freed(prune(g, least)[0], scaling)
