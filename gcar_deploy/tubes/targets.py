"""From vessel images to what the tube fit compares with: blurred and shrunk, level by level."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from gcar_deploy.config import TubeOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.resample import coarsened, coarser_view
from gcar_deploy.tubes.model import Shown
from gcar_deploy.types import Array, Scalars

#: extra blur of the coarse levels (sigma in pixels), which widens the reach of the gradient.
COARSE_BLUR_PX = 0.6
#: which tree explains the pictures better is asked of pixels up to this size, mm at the isocentre
TRIAL_MM = 0.25
#: how many of the paths' relative errors the contrast factor may be off.
CONTRAST_SIGMAS = 6.0


@dataclasses.dataclass(frozen=True, eq=False)
class Target:
    """One view at one level.

    Attributes
    ----------
    carm : CArm, of the picture's size
    path_mm : (rows, cols) float64
    weight : (rows, cols) 0 .. 1, 0 where the picture says nothing
    sigma_mm : (rows, cols) noise of a mm^2 of picture
    box_px : float, width of the averaging box in the model, pixels
    pixel_mm : float, pixel edge at the isocentre
    path_error : float, relative; 0 of calibrated pictures
    contrast : float, factor on the model, 1 for calibrated pictures
    empty_cost : float, sum over pixels of weight log(1 + (path / (c sigma))^2), the robust
        cost of an empty model
    shown : what the picture tells of tubes, and so what the model is
    """

    carm: CArm
    path_mm: Array
    weight: Array
    sigma_mm: Array
    box_px: float
    pixel_mm: float
    path_error: float = 0.0
    contrast: float = 1.0
    empty_cost: float = 0.0
    shown: Shown = "path"

    @property
    def calibrated(self) -> bool:
        """Whether paths are true millimetres."""
        return self.path_error == 0

    def with_contrast(self, covered: Array, model: Scalars) -> Target:
        """Fit the contrast factor to a model by least squares (variable projection).

        Parameters
        ----------
        covered : (g,) flat index of the pixels that the model covers
        model : (g,) its path there, mm
        """
        if self.calibrated:
            return self
        path, weight, sigma = (
            picture.reshape(-1)[covered] for picture in (self.path_mm, self.weight, self.sigma_mm)
        )
        w = weight / sigma**2
        power = float((w * model * model).sum())
        if power <= 0:
            return self
        factor = float((w * model * path).sum()) / power
        most = 1 + CONTRAST_SIGMAS * self.path_error
        return dataclasses.replace(self, contrast=float(np.clip(factor, 1 / most, most)))


def make_targets(
    views: Sequence[VesselImage], level_mm: float, options: TubeOptions
) -> list[Target]:
    """Build the targets of one level.

    Parameters
    ----------
    views : sequence of VesselImage
    level_mm : float
        Pixel wanted at the isocentre, mm; 0 for the picture's own.
    options : TubeOptions
    """
    return [_target(view, level_mm, options) for view in views]


def exact_paths(targets: Sequence[Target]) -> bool:
    """Whether the paths of all views are true mm."""
    return all(target.calibrated for target in targets)


def true_mm(targets: Sequence[Target]) -> bool:
    """Whether each view tells something in true mm: paths, or a mask's widths."""
    return all(target.calibrated or target.shown == "width" for target in targets)


def trial_views(views: Sequence[VesselImage]) -> Sequence[VesselImage]:
    """Coarsen pictures to what trees are tried on; the same ones where none is so fine."""
    factors = [int(TRIAL_MM / view.carm.pixel_at_isocenter_mm + 1e-6) for view in views]
    if max(factors) < 2:
        return views
    return [
        coarser_view(view, factor) if factor > 1 else view
        for view, factor in zip(views, factors, strict=True)
    ]


def _target(view: VesselImage, level_mm: float, options: TubeOptions) -> Target:
    carm = view.carm
    own = carm.pixel_at_isocenter_mm
    factor = max(int(np.floor(level_mm / own + 1e-6)), 1) if level_mm else 1
    path: Array = np.ascontiguousarray(view.path_mm, dtype=np.float32)
    weight: Array = _weight(view, options.centreline_share)
    # Variances in pixels^2 of the working picture; a box of width b has b^2 / 12.
    variance = (options.edge_blur_mm / (own * factor)) ** 2 / 12
    if factor > 1:
        carm, (path, weight) = coarsened(carm, (path, weight), factor)
        variance += (1 - 1 / factor**2) / 12
    if level_mm:
        path = cv2.GaussianBlur(path, (0, 0), COARSE_BLUR_PX)
        variance += COARSE_BLUR_PX**2
    share = max(options.noise_share, view.path_error)
    path = path.astype(np.float64)
    sigma = options.noise_mm + share * path
    some = path > 0
    z = path[some] / (options.robust_sigmas * sigma[some])
    return Target(
        carm=carm,
        path_mm=path,
        weight=weight.astype(np.float64),
        sigma_mm=sigma,
        box_px=max(float(np.sqrt(12 * variance)), 0.05),
        pixel_mm=carm.pixel_at_isocenter_mm,
        path_error=view.path_error,
        empty_cost=float((np.log1p(z * z) * weight[some]).sum()),
        # Candidates still have to share a path, so that those that are none are told by it.
        shown="width" if view.kind == "mask" and not level_mm else "path",
    )


def _weight(view: VesselImage, centreline_share: float) -> Array:
    """(rows, cols) float32 weight of each pixel, some of it moved onto the centreline."""
    weight: Array = view.valid.astype(np.float32)
    line = view.skeleton & view.valid
    count = np.count_nonzero(line)
    if centreline_share <= 0 or not count:
        return weight
    # The centreline takes that share of what the whole vessel weighs.
    vessel = np.count_nonzero(view.mask & view.valid)
    weight *= np.float32(1.0 - centreline_share)
    weight[line] += np.float32(centreline_share * vessel / count)
    return weight
