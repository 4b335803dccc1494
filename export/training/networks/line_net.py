"""A network along lines: which points of a picture's lines are devices, and which are vessel.

Six residual layers of dilated taps along each line, as in WaveNet (van den Oord et al. 2016), and
between them what all lines of the picture have in common: a catheter is told from a vessel by how
it compares with the others, too.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import nn
from torch.nn import functional

from gcar_deploy.imaging.line_strips import DILATIONS, NEAR, POINT

#: what a point is: vessel, device, other line that is no vessel
CLASSES = 3
_TAPS = NEAR // len(DILATIONS)


@dataclasses.dataclass(frozen=True)
class LineNetConfig:
    """Numbers of a point, and the width of every layer."""

    point: int = POINT
    width: int = 64


class Affine(nn.Module):
    """``x @ weight + bias``: a model keeps the weight under its own name."""

    def __init__(self, inside: int, out: int) -> None:
        super().__init__()
        bound = inside**-0.5
        self.weight = nn.Parameter(torch.empty(inside, out).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(out))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(n, inside) to (n, out)."""
        return x @ self.weight + self.bias


class Layer(nn.Module):
    """A point with four others of its line: ``taps`` are numbers of points, (n, 5)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.gather, self.out = Affine(_TAPS * width, width), Affine(width, width)

    def forward(self, x: torch.Tensor, taps: torch.Tensor) -> torch.Tensor:
        """Return (n, width); a tap beyond the line's end sees nothing."""
        # One more row of zeros: what lies beyond a line's end.
        rows = functional.pad(self.norm(x), (0, 0, 0, 1))
        seen = rows[taps].flatten(1)
        added: torch.Tensor = self.out(functional.relu(self.gather(seen)))
        return x + added


class LineNet(nn.Module):
    """Points (n, POINT) of one picture and those near each (n, NEAR) to logits (n, CLASSES)."""

    def __init__(self, config: LineNetConfig | None = None) -> None:
        super().__init__()
        self.config = config or LineNetConfig()
        width = self.config.width
        self.inside = Affine(self.config.point, width)
        self.layers = nn.ModuleList(Layer(width) for _ in DILATIONS)
        self.common = nn.ModuleList(Affine(2 * width, width) for _ in DILATIONS[1::2])
        self.hidden, self.head = Affine(width, width), Affine(width, CLASSES)

    def forward(self, points: torch.Tensor, near: torch.Tensor) -> torch.Tensor:
        """Return logits of vessel, device, other."""
        x = self.inside(points)
        for k, layer in enumerate(self.layers):
            x = layer(x, near[:, k * _TAPS : (k + 1) * _TAPS])
            if k % 2:
                all_lines = torch.cat([x.mean(0), x.amax(0)])[None]
                x = x + self.common[k // 2](all_lines)
        logits: torch.Tensor = self.head(functional.relu(self.hidden(x)))
        return logits


def no_vessel(logits: torch.Tensor) -> torch.Tensor:
    """(n,) probability that a point is of no vessel."""
    return 1 - torch.softmax(logits, dim=1)[:, 0]
