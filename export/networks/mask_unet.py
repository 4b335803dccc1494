"""A small 2D U-Net (Ronneberger et al. 2015) for vessel masks: some 0.2 M parameters."""

from __future__ import annotations

import dataclasses

import torch
from torch import nn
from torch.nn import functional


@dataclasses.dataclass(frozen=True)
class MaskUNetConfig:
    """Channels of the input and of each level, fine to coarse."""

    channels: int = 2
    width: tuple[int, ...] = (10, 20, 40, 80)


class _Pair(nn.Sequential):
    def __init__(self, inside: int, out: int) -> None:
        # Statistics over one picture: the batch is small, and at run time it is one.
        super().__init__(
            nn.Conv2d(inside, out, 3, padding=1, bias=False),
            nn.GroupNorm(min(5, out), out),
            nn.ReLU(),
            nn.Conv2d(out, out, 3, padding=1, bias=False),
            nn.GroupNorm(min(5, out), out),
            nn.ReLU(),
        )


class MaskUNet(nn.Module):
    """(n, channels, rows, cols) to (n, 1, rows, cols) logits; sides divisible by 8."""

    def __init__(self, config: MaskUNetConfig | None = None) -> None:
        super().__init__()
        self.config = config or MaskUNetConfig()
        width = self.config.width
        self.down = nn.ModuleList(
            _Pair(a, b) for a, b in zip((self.config.channels, *width[:-1]), width, strict=True)
        )
        self.up = nn.ModuleList(
            _Pair(a + b, b) for a, b in zip(width[:0:-1], width[-2::-1], strict=True)
        )
        self.head = nn.Conv2d(width[0], 1, 1)
        nn.init.constant_(self.head.bias, -2.5)  # vessels are some 7 % of a picture

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the logits."""
        kept = []
        for k, level in enumerate(self.down):
            x = level(x if k == 0 else functional.max_pool2d(x, 2))
            kept.append(x)
        for k, level in enumerate(self.up):
            finer = kept[-2 - k]
            x = functional.interpolate(x, scale_factor=2.0, mode="nearest")
            x = level(torch.cat([x, finer], dim=1))
        return self.head(x)
