"""The multi-view Gaussian centre predictor: a sparse U-Net on the points that all views see.

Three things pass between points: what touches (27 neighbours on the lattice, on four levels
of coarseness), what shares a ray (mean and maximum over the points behind one pixel, in each
view), and what is still unexplained (the path length that a ray shows less what the present
guess accounts for). The last makes it an unrolled tomography: each stage sees the residual of
the stage before.

Views enter through shared weights and symmetric pooling, so any number in any order will do.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import nn

from gcar_deploy.predict.encoding import LEVELS, VIEW_FEATURES


@dataclasses.dataclass(frozen=True)
class SparseConfig:
    """Sizes of the network."""

    width: tuple[int, ...] = (20, 32, 48, 64)
    stages: int = 3
    ray_width: int = 8


#: below any feature that is passed as a maximum along a ray
LOWEST = -20.0
#: offset (3), radius (1) beside the occupancy logit
EXTRA_OUTPUTS = 4


class _GatherMatmul(torch.autograd.Function):
    """Gather 27 neighbours and multiply, with a backward pass that gathers too.

    Neighbour k of i is j exactly where neighbour 26 - k of j is i, so the transpose of the
    gather is a gather with the offsets mirrored: no scatter, which is slow and unordered.
    """

    @staticmethod
    def forward(
        ctx: Any, x: torch.Tensor, weight: torch.Tensor, neighbours: torch.Tensor
    ) -> torch.Tensor:
        ctx.save_for_backward(x, weight, neighbours)
        out = x.new_empty(len(neighbours), weight.shape[0])
        transposed = weight.t().contiguous()
        for low, high, gathered in _blocks(x, neighbours):
            torch.mm(gathered, transposed, out=out[low:high])
        return out

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, None]:
        x, weight, neighbours = ctx.saved_tensors
        grad_weight = torch.zeros_like(weight)
        for low, high, gathered in _blocks(x, neighbours):
            grad_weight.addmm_(grad[low:high].t(), gathered)
        c_out, c_in = weight.shape[0], x.shape[1]
        mirrored = weight.view(c_out, 27, c_in).flip(1).permute(1, 0, 2).reshape(27 * c_out, c_in)
        grad_x = torch.empty_like(x)
        for low, high, gathered in _blocks(grad.contiguous(), neighbours):
            torch.mm(gathered, mirrored, out=grad_x[low:high])
        return grad_x, grad_weight, None


def _blocks(x: torch.Tensor, neighbours: torch.Tensor) -> Iterator[tuple[int, int, torch.Tensor]]:
    """Yield (low, high, gathered rows): blocks that stay in the cache are several times faster."""
    size = 1024 if x.device.type == "cpu" else 2**18
    c, flat = x.shape[1], neighbours.reshape(-1)
    padded = torch.cat([x, x.new_zeros(1, c)])
    buffer = x.new_empty(27 * size, c)
    for low in range(0, len(neighbours), size):
        high = min(low + size, len(neighbours))
        rows = buffer[: 27 * (high - low)]
        torch.index_select(padded, 0, flat[27 * low : 27 * high], out=rows)
        yield low, high, rows.view(high - low, 27 * c)


class GatherConv(nn.Module):
    """A 3x3x3 convolution on sparse points: gather 27 neighbours, one matrix product."""

    def __init__(self, c_in: int, c_out: int) -> None:
        super().__init__()
        self.linear = nn.Linear(27 * c_in, c_out)
        nn.init.normal_(self.linear.weight, std=(2.0 / (9 * c_in)) ** 0.5)

    def forward(self, x: torch.Tensor, neighbours: torch.Tensor) -> torch.Tensor:
        """(n, c_in) and (n, 27) to (n, c_out)."""
        if self.training:
            weight = self.linear.weight
            if torch.is_autocast_enabled(x.device.type):
                kind = torch.get_autocast_dtype(x.device.type)
                x, weight = x.to(kind), weight.to(kind)
            return _GatherMatmul.apply(x, weight, neighbours) + self.linear.bias
        padded = torch.cat([x, x.new_zeros(1, x.shape[1])])
        gathered = padded.index_select(0, neighbours.reshape(-1)).reshape(-1, 27 * x.shape[1])
        return self.linear(gathered)


class Residual(nn.Module):
    """Normalise, convolve, activate, mix, add."""

    def __init__(self, c: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(c)
        self.conv = GatherConv(c, c)
        self.mix = nn.Linear(c, c)
        nn.init.zeros_(self.mix.weight)
        nn.init.zeros_(self.mix.bias)

    def forward(self, x: torch.Tensor, neighbours: torch.Tensor) -> torch.Tensor:
        """(n, c) to (n, c)."""
        return x + self.mix(torch.relu(self.conv(self.norm(x), neighbours)))


class RayExchange(nn.Module):
    """Let the points behind one pixel see each other, and what their ray still lacks."""

    def __init__(self, c: int, c_ray: int) -> None:
        super().__init__()
        self.c_ray = c_ray
        self.down = nn.Linear(c, 2 * c_ray)
        self.view = nn.Sequential(nn.Linear(4 * c_ray + VIEW_FEATURES + 5, 2 * c), nn.ReLU())
        self.out = nn.Linear(4 * c, c)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(
        self, x: torch.Tensor, guess: torch.Tensor, features: torch.Tensor, ray: torch.Tensor,
        ray_path: torch.Tensor, weight: torch.Tensor, members: torch.Tensor | None = None,
    ) -> torch.Tensor:  # fmt: skip
        """(n, c) with the arrays of ``Encoded`` to (n, c)."""
        v, n = ray.shape
        r = ray_path.shape[1]
        # All views at once: the rays of view k are numbered from k r.
        flat = (ray + torch.arange(v, device=ray.device)[:, None] * r).reshape(-1)
        path = ray_path.reshape(-1, 1)
        alone = self.down(x)
        z = alone.expand(v, n, 2 * self.c_ray).reshape(v * n, 2 * self.c_ray)
        contribution = (guess[None, :, 0] * weight).reshape(-1, 1)
        if members is None:
            mean, top, made = self._scattered(z, contribution, flat, v * r)
        else:
            mean, top, made = self._gathered(alone, guess[None, :, 0] * weight, members)
        per_ray = torch.cat([mean, top, (path - made).clamp(-4, 4), made.clamp(max=8)], dim=1)
        back = per_ray.index_select(0, flat)
        explained = path.index_select(0, flat).clamp(max=8)
        rivals = (back[:, -1:] - contribution).clamp(-4, 8)
        known = torch.cat(
            [
                back,
                z,
                features.reshape(v * n, -1),
                guess.expand(v, n, 1).reshape(-1, 1),
                explained,
                rivals,
            ],
            dim=1,
        )
        message = self.view(known).reshape(v, n, -1)
        return x + self.out(torch.cat([message.mean(0), message.amax(0)], dim=1))

    def _scattered(
        self, z: torch.Tensor, contribution: torch.Tensor, flat: torch.Tensor, rays: int
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Mean, maximum and account per ray by scatter: for training, sums in single precision."""
        z = z.to(torch.promote_types(z.dtype, torch.float32))
        ones = torch.ones_like(contribution)
        summed = torch.cat([z[:, : self.c_ray], ones, contribution], dim=1)
        total = z.new_zeros(rays, self.c_ray + 2).index_add(0, flat, summed)
        mean = total[:, : self.c_ray] / total[:, self.c_ray : self.c_ray + 1].clamp(min=1)
        index = flat[:, None].expand(len(flat), self.c_ray)
        lowest = z.new_full((rays, self.c_ray), LOWEST)
        top = lowest.scatter_reduce(0, index, z[:, self.c_ray :], "amax")
        return mean, top, total[:, self.c_ray + 1 :]

    def _gathered(
        self, alone: torch.Tensor, contribution: torch.Tensor, members: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Gather the same three: for deployment, where scatters race between threads."""
        v, r, k = members.shape
        n = alone.shape[0]
        flat = members.reshape(-1)
        zero = alone.new_zeros(1, self.c_ray)
        low = torch.cat([alone[:, : self.c_ray], zero]).index_select(0, flat)
        high = torch.cat([alone[:, self.c_ray :], zero + LOWEST]).index_select(0, flat)
        count = (members < n).to(alone.dtype).sum(2).reshape(-1, 1).clamp(min=1)
        mean = low.reshape(v * r, k, self.c_ray).sum(1) / count
        # The floor keeps rays without points, and what lies below it, as the scatter does.
        top = high.reshape(v * r, k, self.c_ray).amax(1).clamp(min=LOWEST)
        padded = torch.cat([contribution, contribution.new_zeros(v, 1)], dim=1)
        made = padded.gather(1, members.reshape(v, r * k)).reshape(v * r, k).sum(1, keepdim=True)
        return mean, top, made


class Level(nn.Module):
    """One stage: a U-Net over the levels, with rays exchanged on the finest before and after."""

    def __init__(self, config: SparseConfig) -> None:
        super().__init__()
        w = config.width
        self.rays_in = RayExchange(w[0], config.ray_width)
        self.first = Residual(w[0])
        self.down = nn.ModuleList([nn.Linear(w[k], w[k + 1]) for k in range(LEVELS)])
        self.coarse = nn.ModuleList([Residual(w[k + 1]) for k in range(LEVELS)])
        self.coarse_up = nn.ModuleList([Residual(w[k + 1]) for k in range(LEVELS)])
        self.up = nn.ModuleList([nn.Linear(w[k + 1], w[k]) for k in range(LEVELS)])
        self.last = Residual(w[0])
        self.head = nn.Sequential(nn.LayerNorm(w[0]), nn.Linear(w[0], 1 + EXTRA_OUTPUTS))

    def forward(
        self, x: torch.Tensor, guess: torch.Tensor, features: torch.Tensor, ray: torch.Tensor,
        ray_path: torch.Tensor, weight: torch.Tensor, neighbours: Sequence[torch.Tensor],
        parent: Sequence[torch.Tensor], members: torch.Tensor | None = None,
        children: Sequence[torch.Tensor] | None = None,
    ) -> torch.Tensor:  # fmt: skip
        """(n, c) with the arrays of ``Encoded`` to (n, c)."""
        x = self.rays_in(x, guess, features, ray, ray_path, weight, members)
        x = self.first(x, neighbours[0])
        skips, y = [x], x
        for k in range(LEVELS):
            y = self.down[k](y)
            if children is None:
                y = _pool(y, parent[k], neighbours[k + 1].shape[0])
            else:
                y = _pool_gathered(y, children[k])
            y = self.coarse[k](y, neighbours[k + 1])
            skips.append(y)
        for k in reversed(range(LEVELS)):
            y = self.coarse_up[k](y, neighbours[k + 1])
            y = skips[k] + self.up[k](y).index_select(0, parent[k])
        return self.last(y, neighbours[0])


def _pool(x: torch.Tensor, parent: torch.Tensor, n: int) -> torch.Tensor:
    x = x.to(torch.promote_types(x.dtype, torch.float32))
    ones = torch.ones(x.shape[0], 1, dtype=x.dtype, device=x.device)
    total = x.new_zeros(n, x.shape[1] + 1).index_add(0, parent, torch.cat([x, ones], dim=1))
    return total[:, :-1] / total[:, -1:].clamp(min=1)


def _pool_gathered(x: torch.Tensor, children: torch.Tensor) -> torch.Tensor:
    n, c = x.shape
    padded = torch.cat([x, x.new_zeros(1, c)])
    total = padded.index_select(0, children.reshape(-1)).reshape(-1, 8, c).sum(1)
    count = (children < n).to(x.dtype).sum(1, keepdim=True)
    return total / count.clamp(min=1)


class SparsePredictor(nn.Module):
    """From the arrays of ``encode`` to occupancy, offset and radius per point."""

    def __init__(self, config: SparseConfig | None = None) -> None:
        super().__init__()
        self.config = config or SparseConfig()
        w = self.config.width[0]
        self.embed = nn.Sequential(nn.Linear(VIEW_FEATURES, w), nn.ReLU(), nn.Linear(w, w))
        self.start = nn.Sequential(nn.Linear(2 * w, w), nn.ReLU(), nn.Linear(w, w))
        self.levels = nn.ModuleList([Level(self.config) for _ in range(self.config.stages)])

    def forward(
        self, features: torch.Tensor, ray: torch.Tensor, ray_path: torch.Tensor,
        weight: torch.Tensor, neighbours: Sequence[torch.Tensor], parent: Sequence[torch.Tensor],
        members: torch.Tensor | None = None, children: Sequence[torch.Tensor] | None = None,
    ) -> list[torch.Tensor]:  # fmt: skip
        """Return per stage (n, 5): occupancy logit, offset in cells (3), radius in cells."""
        e = self.embed(features)
        x = self.start(torch.cat([e.mean(0), e.amax(0)], dim=1))
        guess = features[:, :, 8:9].amin(0).clamp(max=1.0) * 0.5
        outputs = []
        for level in self.levels:
            x = level(
                x, guess, features, ray, ray_path, weight, neighbours, parent, members, children
            )
            out = level.head(x)
            outputs.append(out)
            guess = torch.sigmoid(out[:, :1])
        return outputs
