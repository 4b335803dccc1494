"""A small 2D U-Net (Ronneberger et al. 2015) for vessels, chords through them, and devices."""

from __future__ import annotations

import dataclasses

import torch
from torch import nn
from torch.nn import functional

#: pixel edges per unit of the chord head
CHORD_SCALE = 4.0


@dataclasses.dataclass(frozen=True)
class MaskUNetConfig:
    """Channels of the input and of each level, fine to coarse."""

    channels: int = 3
    width: tuple[int, ...] = (16, 32, 64, 128, 192)


class Pair(nn.Sequential):
    """Two convolutions, each with its norm."""

    def __init__(self, inside: int, out: int) -> None:
        # Statistics over one picture: the batch is small, and at run time it is one.
        super().__init__(
            nn.Conv2d(inside, out, 3, padding=1, bias=False),
            nn.GroupNorm(4, out),
            nn.ReLU(),
            nn.Conv2d(out, out, 3, padding=1, bias=False),
            nn.GroupNorm(4, out),
            nn.ReLU(),
        )


class MaskUNet(nn.Module):
    """(n, channels, rows, cols) to (n, 3, rows, cols): logits of vessel, chords, logits of device.

    Chords are in pixel edges, sides divisible by 16.
    """

    def __init__(self, config: MaskUNetConfig | None = None) -> None:
        super().__init__()
        self.config = config or MaskUNetConfig()
        width = self.config.width
        self.down = nn.ModuleList(
            Pair(a, b) for a, b in zip((self.config.channels, *width[:-1]), width, strict=True)
        )
        self.up = nn.ModuleList(
            Pair(a + b, b) for a, b in zip(width[:0:-1], width[-2::-1], strict=True)
        )
        self.head = nn.Conv2d(width[0], 3, 1)
        nn.init.constant_(self.head.bias, -2.5)  # vessels are some 7 % of a picture

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return logits of vessel, chords, and logits of catheter, lead or wire."""
        kept = []
        for k, level in enumerate(self.down):
            x = level(x if k == 0 else functional.max_pool2d(x, 2))
            kept.append(x)
        for k, level in enumerate(self.up):
            finer = kept[-2 - k]
            x = functional.interpolate(x, scale_factor=2.0, mode="nearest")
            x = level(torch.cat([x, finer], dim=1))
        logit, chord, device = self.head(x).split(1, dim=1)
        # Chords are up to 30 pixels: the head need not grow that large itself.
        return torch.cat([logit, CHORD_SCALE * functional.softplus(chord), device], dim=1)
