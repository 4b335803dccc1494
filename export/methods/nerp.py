"""Implicit network fitted to the views of one patient (after NeRP: Shen, Pauly, Xing 2022).

A coordinate network with random Fourier features (Tancik et al. 2020) gives the occupancy of
every voxel; its projections are fitted to the pictures by Adam, without any other data. Two
things differ from the original, both in its favour on a CPU: only voxels that every view sees
as vessel are asked (occupancy is not negative, so a ray without vessel rules out all of its
voxels), which makes each step a whole pass over all rays; and the steps end by a rule rather
than after a fixed number.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import sparse
from scipy.special import logit

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.types import Array, Image, Volume

#: distance between samples along a ray, voxels.
STEP_VOXELS = 0.5
#: called with (step, loss, function that makes the volume) after each step.
OnStep = Callable[[int, float, Callable[[], Volume]], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class NerpOptions:
    """Settings of ``nerp``; bandwidth and network size were chosen on generated trees.

    Attributes
    ----------
    features : random Fourier features, a sine and a cosine each
    bandwidth : standard deviation of their frequencies, cycles per edge of the volume
    width, hidden_layers : of the network (ReLU; the last layer a sigmoid)
    learning_rate : of Adam, falling to ``final_rate`` of it along a cosine over ``steps``
    steps : at most so many, each over all rays
    patience, tolerance : end when the lowest loss of the last ``patience`` steps is not lower
        by this share than the lowest before them
    least_path_mm : a ray rules out its voxels below this path length
    seed : of frequencies and weights
    """

    features: int = 64
    bandwidth: float = 8.0
    width: int = 64
    hidden_layers: int = 3
    learning_rate: float = 3e-3
    final_rate: float = 0.1
    steps: int = 400
    patience: int = 50
    tolerance: float = 0.05
    least_path_mm: float = 0.1
    seed: int = 0


def nerp(
    path_mm: Sequence[Image],
    carms: Sequence[CArm],
    grid: Grid,
    options: NerpOptions | None = None,
    on_step: OnStep | None = None,
) -> Volume:
    """Reconstruct occupancy from path-length pictures.

    Pictures should have pixels of about a voxel: finer ones cost time only.

    Parameters
    ----------
    path_mm : pictures (rows, columns), mm of vessel along each pixel's ray
    carms : their views
    grid : voxels wanted
    options : NerpOptions
    on_step : called after each step, for curves of convergence

    Returns
    -------
    (nx, ny, nz) float32, 0 .. 1
    """
    options = options or NerpOptions()
    voxels = seen_voxels(path_mm, carms, grid, options.least_path_mm)
    empty: Volume = np.zeros(grid.shape, np.float32)
    if not len(voxels):
        return empty
    parts = [ray_matrix(c, grid, voxels) for c in carms]
    kept = [np.flatnonzero(np.diff(part.indptr)) for part in parts]
    matrix = sparse.vstack([part[rows] for part, rows in zip(parts, kept, strict=True)]).tocsr()
    measured = np.concatenate(
        [np.ravel(p)[rows] for p, rows in zip(path_mm, kept, strict=True)]
    ).astype(np.float32)
    values = _fit(matrix, measured, voxels, grid, options, on_step)
    return _filled(grid, voxels, values)


def seen_voxels(
    path_mm: Sequence[Image], carms: Sequence[CArm], grid: Grid, least_path_mm: float
) -> Array:
    """(n, 3) indices of the voxels at whose centre every view shows vessel.

    Path lengths are interpolated between the pixels, so that voxels at a vessel's rim stay.
    """
    from scipy.ndimage import map_coordinates

    index = np.indices(grid.shape).reshape(3, -1).T
    for picture, carm in zip(path_mm, carms, strict=True):
        pixels, depth = carm.project(grid.index2world(index))
        path = map_coordinates(picture.astype(np.float64), pixels.T[::-1], order=1)
        index = index[(depth > 0) & (path >= least_path_mm)]
    return index


def ray_matrix(carm: CArm, grid: Grid, voxels: Array) -> sparse.csr_matrix:
    """(rows * columns, n) mm of each ray within each voxel, by trilinear samples.

    Parameters
    ----------
    carm : the view; one ray per pixel centre
    grid : Grid
    voxels : (n, 3) indices; all others count as empty
    """
    step = STEP_VOXELS * float(np.min(grid.spacing_mm))
    row, column = _pixels_near(carm, grid, voxels)
    pixel = np.column_stack([column, row]).astype(np.float64)
    source = carm.source_mm
    ray = carm.backproject(pixel, np.ones(len(pixel))) - source
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    reach = 0.5 * float(np.linalg.norm(grid.size_mm)) + step
    middle = float(np.linalg.norm(np.asarray(grid.center_mm) - source))
    number = np.full(np.asarray(grid.shape) + 1, -1, np.int64)  # the last layer stays outside
    number[tuple(voxels.T)] = np.arange(len(voxels))
    flat = row * carm.columns + column
    corners = np.indices((2, 2, 2)).reshape(3, -1).T
    rows, cols, weights = [], [], []
    for distance in np.arange(middle - reach, middle + reach, step):
        at = grid.world2index(source + distance * ray)
        base = np.floor(at).astype(np.int64)
        inside = ((base >= -1) & (base < np.asarray(grid.shape))).all(axis=1)
        base, share, where = base[inside], (at - np.floor(at))[inside], flat[inside]
        for corner in corners:
            voxel = number[tuple((base + corner).T)]
            hit = voxel >= 0
            weight = np.prod(np.where(corner, share[hit], 1 - share[hit]), axis=1)
            rows.append(where[hit])
            cols.append(voxel[hit])
            weights.append(step * weight)
    entries = (np.concatenate(weights).astype(np.float32), _pairs(rows, cols))
    return sparse.coo_matrix(entries, shape=(carm.rows * carm.columns, len(voxels))).tocsr()


def _pairs(rows: list[Array], cols: list[Array]) -> tuple[Array, Array]:
    return np.concatenate(rows), np.concatenate(cols)


def _pixels_near(carm: CArm, grid: Grid, voxels: Array) -> tuple[Array, Array]:
    """Rows and columns of the pixels whose rays may touch one of the voxels."""
    from scipy.ndimage import binary_dilation

    pixels, _ = carm.project(grid.index2world(voxels))
    reach = int(np.ceil(np.max(grid.spacing_mm) / carm.pixel_at_isocenter_mm)) + 1
    near = np.zeros((carm.rows, carm.columns), bool)
    column, row = np.rint(pixels).astype(int).T
    near[np.clip(row, 0, carm.rows - 1), np.clip(column, 0, carm.columns - 1)] = True
    row, column = np.nonzero(binary_dilation(near, np.ones((3, 3)), iterations=reach))
    return row, column


def _fit(
    matrix: sparse.csr_matrix,
    measured: Array,
    voxels: Array,
    grid: Grid,
    options: NerpOptions,
    on_step: OnStep | None,
) -> Array:
    """(n,) occupancies at the lowest loss."""
    import torch

    # Numbers from numpy: torch's own generator is shared by all threads of a process.
    rng = np.random.default_rng(options.seed)
    # Positions in volume edges, so that frequencies are cycles per edge.
    place = torch.as_tensor((voxels + 0.5) / np.asarray(grid.shape), dtype=torch.float32)
    waves = options.bandwidth * rng.standard_normal((3, options.features))
    turns = 2 * torch.pi * place @ torch.as_tensor(waves, dtype=torch.float32)
    encoded = torch.cat([torch.sin(turns), torch.cos(turns)], dim=1)
    # Start with the vessel volume that the pictures show, evenly spread: from far more, the
    # first steps would push every voxel into the flat end of the sigmoid.
    share = float(measured.sum()) / max(float(matrix.sum()), 1e-9)
    network = _network(encoded.shape[1], options, rng, float(logit(np.clip(share, 0.01, 0.9))))
    adam = torch.optim.Adam(network.parameters(), lr=options.learning_rate)
    cosine = torch.optim.lr_scheduler.CosineAnnealingLR(
        adam, options.steps, options.final_rate * options.learning_rate
    )
    project = _projection(matrix)
    target = torch.as_tensor(measured)
    losses: list[float] = []
    best = np.zeros(len(voxels), np.float32)
    for step in range(options.steps):
        occupancy = network(encoded)[:, 0]
        loss = torch.mean((project(occupancy) - target) ** 2)
        losses.append(float(loss.detach()))
        if losses[-1] <= min(losses):
            best = occupancy.detach().numpy().copy()
        if on_step is not None:
            on_step(step, losses[-1], functools.partial(_filled, grid, voxels, best))
        if _converged(losses, options):
            break
        adam.zero_grad()
        loss.backward()
        adam.step()
        cosine.step()
    return best


def _network(inputs: int, options: NerpOptions, rng: np.random.Generator, bias: float) -> Any:
    """ReLU layers and a sigmoid, weights uniform within 1 / sqrt(inputs) (torch's default)."""
    import torch

    layers: list[torch.nn.Module] = []
    for outputs in (*[options.width] * options.hidden_layers, 1):
        layer = torch.nn.Linear(inputs, outputs)
        bound = inputs**-0.5
        with torch.no_grad():
            for parameter in (layer.weight, layer.bias):
                drawn = rng.uniform(-bound, bound, tuple(parameter.shape))
                parameter.copy_(torch.as_tensor(drawn))
        layers += [layer, torch.nn.ReLU()]
        inputs = outputs
    torch.nn.init.constant_(layer.bias, bias)
    return torch.nn.Sequential(*layers[:-1], torch.nn.Sigmoid())


def _projection(matrix: sparse.csr_matrix) -> Any:
    """Return the sparse product as a differentiable function of a torch vector."""
    import torch

    transposed = matrix.T.tocsr()

    class Project(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, x: Any) -> Any:
            return torch.from_numpy(matrix @ x.detach().numpy())

        @staticmethod
        def backward(ctx: Any, gradient: Any) -> Any:
            return torch.from_numpy(transposed @ gradient.numpy())

    return Project.apply


def _converged(losses: Sequence[float], options: NerpOptions) -> bool:
    k = options.patience
    if len(losses) < 2 * k:
        return False
    return min(losses[-k:]) > (1 - options.tolerance) * min(losses[:-k])


def _filled(grid: Grid, voxels: Array, values: Array) -> Volume:
    out = np.zeros(grid.shape, np.float32)
    out[tuple(voxels.T)] = np.clip(values, 0, 1)
    return out
