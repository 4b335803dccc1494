"""Losses of the single-view predictor, each in a reading that never leaves the finite numbers.

    L = gamma1 L_chamfer + 0.5 L_clDice + 0.01 L_depth          (3DGR-CAR, section 2.2)

What the printed formulae leave open, and the reading taken here:

- gamma1 = 2 log(Iter / 20000) is negative before iteration 20,000 and would push points apart.
  ``clamp`` (default) starts it there, after a warm-up without; ``shifted`` is
  2 log(1 + Iter / 20000); ``decaying`` is 2 log(20000 / Iter), clamped at zero.
- SILog takes logarithms of d + 1e-3 with d in 0 .. 1, the variance is the biased one, and
  sqrt(x + 1e-8) - 1e-4 keeps the slope finite at exact agreement.
- ``sum`` takes the gradient and masked terms as printed, sums over the map, and 0.01 of all three.
  ``mean`` (default) takes means, which do not depend on the picture's size; the printed 0.01
  weighs sums, and ``DEPTH_SCALE`` stands for what they are larger. Without it the slope of clDice,
  noise far from the truth, outweighs that of depth seventy times (measured), and what depth has
  learned is lost again; with sums the gradient term alone carries nearly all of the slope.
- clDice is the printed Dice of two skeletons, with the smoothing of Shit et al. 2021.
- A term that is undefined (no predicted point, no true one, fewer than two pixels) is None: the
  sample is left out of that term and counted.
"""

from __future__ import annotations

import math

import torch
from torch.nn import functional

GAMMA_CLDICE = 0.5
GAMMA_DEPTH = 0.01
#: iteration at which the paper's schedule changes sign
PAPER_START = 20_000
SCHEDULES = ("clamp", "shifted", "decaying")
#: SILog: offset of the logarithms and weight of the mean
LOG_OFFSET = 1e-3
MEAN_WEIGHT = 0.15
#: see above
DEPTH_SCALE = 100.0
DEPTH_TERMS = ("mean", "sum")


def chamfer_weight(iteration: int, start: int = PAPER_START, schedule: str = "clamp") -> float:
    """gamma1 at an iteration; never negative, finite everywhere.

    Raises
    ------
    ValueError
        An unknown schedule, or ``start`` below 1.
    """
    if start < 1:
        raise ValueError(f"start = {start} must be 1 or more")
    if schedule == "clamp":
        return 2.0 * math.log(max(iteration / start, 1.0))
    if schedule == "shifted":
        return 2.0 * math.log1p(max(iteration, 0) / start)
    if schedule == "decaying":
        return 2.0 * math.log(max(start / max(iteration, 1), 1.0))
    raise ValueError(f"schedule {schedule!r} is none of {', '.join(SCHEDULES)}")


def chamfer(predicted: torch.Tensor, truth: torch.Tensor) -> torch.Tensor | None:
    """Mean squared distance to the nearest point of the other set, both ways, summed.

    Parameters
    ----------
    predicted, truth : (n, 3) and (m, 3), one unit of length

    Returns
    -------
    scalar, or None where a set is empty
    """
    if not len(predicted) or not len(truth):
        return None
    # Nearest partners without gradient, distances to them with: no n x m graph is kept.
    with torch.no_grad():
        # A product of matrices would cancel; n x m differences are exact.
        distance = torch.cdist(predicted, truth, compute_mode="donot_use_mm_for_euclid_dist")
        there, back = distance.argmin(dim=1), distance.argmin(dim=0)
    to_truth = (predicted - truth[there]).square().sum(dim=1).mean()
    to_predicted = (truth - predicted[back]).square().sum(dim=1).mean()
    return to_truth + to_predicted


def silog(predicted: torch.Tensor, truth: torch.Tensor) -> torch.Tensor | None:
    """Scale-invariant logarithmic loss of (n,) depths in 0 .. 1; None below two of them."""
    if len(predicted) < 2:
        return None
    g = torch.log(predicted + LOG_OFFSET) - torch.log(truth + LOG_OFFSET)
    spread = g.var(unbiased=False) + MEAN_WEIGHT * g.mean().square()
    return 10.0 * (torch.sqrt(spread + 1e-8) - 1e-4)


def depth_weight(terms: str = "mean") -> float:
    """gamma3 of a reading of the depth loss, one of ``DEPTH_TERMS``."""
    return GAMMA_DEPTH * (DEPTH_SCALE if terms == "mean" else 1.0)


def depth_loss(
    predicted: torch.Tensor, truth: torch.Tensor, mask: torch.Tensor, terms: str = "mean"
) -> torch.Tensor | None:
    """SILog + gradient L1 + masked squared error over one picture's foreground.

    Parameters
    ----------
    predicted, truth : (h, w) depth 0 .. 1
    mask : (h, w) bool, where the truth is known
    terms : one of ``DEPTH_TERMS``, what the second and third term are over the map

    Returns
    -------
    scalar, or None where fewer than two pixels are known

    Raises
    ------
    ValueError
        Unknown ``terms``.
    """
    if terms not in DEPTH_TERMS:
        raise ValueError(f"terms {terms!r} is none of {', '.join(DEPTH_TERMS)}")
    predicted, truth = predicted.float(), truth.float()
    scale = silog(predicted[mask], truth[mask])
    if scale is None:
        return None
    wrong = torch.where(mask, predicted - truth, torch.zeros_like(predicted))
    mean = terms == "mean"
    total = scale + wrong.square().sum() / (mask.sum() if mean else 1)
    for dim in (0, 1):
        n = mask.shape[dim]
        both = mask.narrow(dim, 0, n - 1) & mask.narrow(dim, 1, n - 1)
        step = torch.where(both, wrong.diff(dim=dim), torch.zeros_like(wrong.narrow(dim, 1, n - 1)))
        total = total + step.abs().sum() / (both.sum().clamp(min=1) if mean else 1)
    return total


def splat(points: torch.Tensor, size: int, strength: float = 2.0) -> torch.Tensor:
    """(size, size, size) occupancy 0 .. 1 of (n, 3) points in -1 .. 1, with a gradient.

    Each point is shared among the eight voxels round it; what adds up is saturated by
    1 - exp(-strength x), so crowded voxels do not count more than full ones. Points outside are
    left out.
    """
    at = (points + 1) * (0.5 * size) - 0.5
    base = torch.floor(at.detach())
    part = at - base
    base = base.long()
    total = points.new_zeros(size**3)
    for corner in range(8):
        step = torch.tensor([corner >> 2 & 1, corner >> 1 & 1, corner & 1], device=points.device)
        index = base + step
        inside = ((index >= 0) & (index < size)).all(dim=1)
        share = torch.where(step.bool(), part, 1 - part).prod(dim=1)
        flat = (index[:, 0] * size + index[:, 1]) * size + index[:, 2]
        total = total.index_add(0, flat[inside], share[inside])
    return (1 - torch.exp(-strength * total)).reshape(size, size, size)


def soft_skeleton(volume: torch.Tensor, iterations: int) -> torch.Tensor:
    """Soft skeleton of a (B, 1, x, y, z) volume, Shit et al. 2021, algorithm 1.

    ``iterations`` must reach the largest radius in voxels, or thick vessels stay thick.
    """
    opened = _dilated(_eroded(volume))
    skeleton = torch.relu(volume - opened)
    for _ in range(iterations):
        volume = _eroded(volume)
        ridge = torch.relu(volume - _dilated(_eroded(volume)))
        skeleton = skeleton + torch.relu(ridge - skeleton * ridge)
    return skeleton


def skeleton_dice_loss(
    predicted: torch.Tensor, truth: torch.Tensor, iterations: int = 2
) -> torch.Tensor:
    """1 - Dice of two volumes' soft skeletons; 0 where both are empty.

    Parameters
    ----------
    predicted, truth : (x, y, z) occupancy 0 .. 1
    """
    a, b = (soft_skeleton(v[None, None].float(), iterations) for v in (predicted, truth))
    return 1 - (2 * (a * b).sum() + 1) / (a.sum() + b.sum() + 1)


def _eroded(x: torch.Tensor) -> torch.Tensor:
    """Return the least of each voxel's neighbours along the three axes."""
    out = x
    for kernel in ((3, 1, 1), (1, 3, 1), (1, 1, 3)):
        padding = tuple(k // 2 for k in kernel)
        out = torch.minimum(out, -functional.max_pool3d(-x, kernel, 1, padding))
    return out


def _dilated(x: torch.Tensor) -> torch.Tensor:
    return functional.max_pool3d(x, 3, 1, 1)
