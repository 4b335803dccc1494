"""The torch twin of ``project``: dense, obvious, differentiable; a reference, not a fast path.

Torch is imported when a function is called, never with the package.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from gcar_deploy.errors import UsageError
from gcar_deploy.gaussians.footprint import PIXEL_VARIANCE, footprint
from gcar_deploy.gaussians.gaussians import TWO_PI_3_2, Gaussians
from gcar_deploy.gaussians.project import Gradient
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.types import Array

#: Gaussians handled at once by the array functions; bounds the memory to some 100 MB at 128^2
CHUNK = 128

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


def check_device(device: str) -> None:
    """Make sure that torch is there, and the device with it.

    Raises
    ------
    UsageError
        It is not; the sentence says what to install.
    """
    try:
        import torch
    except ImportError:
        raise UsageError("backend torch is not installed: pip install 'gcar[torch]'") from None
    if device == "cuda" and not torch.cuda.is_available():
        raise UsageError("device cuda: torch sees no CUDA device here; use cpu")


def project_arrays(g: Gaussians, carm: CArm, device: str = "cpu") -> Array:
    """Like ``project``, by torch; Gaussians that are not in front of the source are left out."""
    import torch

    image = torch.zeros((carm.rows, carm.columns), dtype=torch.float64, device=device)
    with torch.no_grad():
        for part in _chunks(g, carm):
            means, scales, quaternions, intensity = _tensors(g, part, device)
            image += torch_project(means, scales, quaternions, intensity, carm)
    return np.asarray(image.cpu().numpy())


def vjp_arrays(g: Gaussians, carm: CArm, grad_image: Array, device: str = "cpu") -> Gradient:
    """Like ``project_vjp``, by torch's own differentiation."""
    import torch

    pull = torch.as_tensor(np.asarray(grad_image, dtype=np.float64), device=device)
    shapes = ((len(g), 3), (len(g), 3), (len(g), 4), (len(g),))
    found = [np.zeros(shape) for shape in shapes]
    for part in _chunks(g, carm):
        tensors = [t.requires_grad_() for t in _tensors(g, part, device)]
        made = torch_project(tensors[0], tensors[1], tensors[2], tensors[3], carm)
        for array, grad in zip(found, torch.autograd.grad(made, tensors, pull), strict=True):
            array[part] = grad.cpu().numpy()
    return Gradient(
        means_mm=found[0], log_scales=found[1], quaternions_wxyz=found[2], intensity=found[3]
    )


def _chunks(g: Gaussians, carm: CArm) -> list[Array]:
    """Return the Gaussians in front of the source, some indices at a time."""
    seen = np.flatnonzero(footprint(g, carm).seen)
    return [seen[k : k + CHUNK] for k in range(0, len(seen), CHUNK)]


def _tensors(g: Gaussians, part: Array, device: str) -> list[torch.Tensor]:
    import torch

    quaternions = g.quaternions_wxyz[part].copy()
    # A zero quaternion is the identity, without a gradient of its own to speak of.
    quaternions[np.linalg.norm(quaternions, axis=1) <= 1e-12] = (1.0, 0.0, 0.0, 0.0)
    arrays = (g.means_mm[part], np.log(g.scales_mm[part]), quaternions, g.intensity[part])
    return [torch.as_tensor(a, dtype=torch.float64, device=device).clone() for a in arrays]


def _rotations(q: torch.Tensor) -> torch.Tensor:
    import torch

    w, x, y, z = (q / torch.linalg.norm(q, dim=1, keepdim=True)).unbind(1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
    ]
    return torch.stack(rows, dim=1)
