"""The torch twin of ``project``: dense, obvious, differentiable; a reference, not a fast path.

Torch is imported when a function is called, never with the package.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gcar_deploy.gaussians.footprint import PIXEL_VARIANCE
from gcar_deploy.gaussians.gaussians import TWO_PI_3_2
from gcar_deploy.geometry.carm import CArm

if TYPE_CHECKING:
    import torch


def torch_project(
    means_mm: torch.Tensor,
    log_scales: torch.Tensor,
    quaternions_wxyz: torch.Tensor,
    intensity: torch.Tensor,
    carm: CArm,
) -> torch.Tensor:
    """Path length of every pixel through n Gaussians, on the tensors' own device.

    Parameters
    ----------
    means_mm (n, 3), log_scales (n, 3) of mm, quaternions_wxyz (n, 4), intensity (n,)
    carm : CArm

    Returns
    -------
    (rows, columns) tensor, mm; every Gaussian reaches every pixel
    """
    import torch

    options: dict[str, Any] = {"dtype": means_mm.dtype, "device": means_mm.device}
    P = torch.as_tensor(carm.world2pixel, **options)
    h = means_mm @ P[:, :3].T + P[:, 3]
    depth, centre = h[:, 2], h[:, :2] / h[:, 2:]
    J = (P[None, :2, :3] - centre[:, :, None] * P[None, 2:, :3]) / depth[:, None, None]
    half = _rotations(quaternions_wxyz) * torch.exp(log_scales)[:, None, :]
    cov = J @ half @ half.transpose(1, 2) @ J.transpose(1, 2)
    cov = cov + PIXEL_VARIANCE * torch.eye(2, **options)
    kappa = torch.sqrt(torch.linalg.det(J @ J.transpose(1, 2)))
    mass = intensity * TWO_PI_3_2 * torch.exp(log_scales.sum(dim=1))
    amplitude = mass * kappa / (2 * torch.pi * torch.sqrt(torch.linalg.det(cov)))
    cols, rows = torch.arange(carm.columns, **options), torch.arange(carm.rows, **options)
    grid = torch.stack(torch.meshgrid(cols, rows, indexing="xy"), dim=-1).reshape(-1, 2)
    delta = grid[None] - centre[:, None]
    q = torch.einsum("nki,nij,nkj->nk", delta, torch.linalg.inv(cov), delta)
    image = (amplitude[:, None] * torch.exp(-0.5 * q)).sum(dim=0)
    return image.reshape(carm.rows, carm.columns)


def _rotations(q: torch.Tensor) -> torch.Tensor:
    import torch

    w, x, y, z = (q / torch.linalg.norm(q, dim=1, keepdim=True)).unbind(1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
    ]
    return torch.stack(rows, dim=1)
