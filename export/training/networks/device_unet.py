"""A 2D U-Net at half resolution for catheters, leads and wires, beside a segmenter that stays."""

from __future__ import annotations

import dataclasses

import torch
from torch import nn
from torch.nn import functional

from gcar_export.training.networks.mask_unet import Pair

#: rates of the coarsest level's convolutions: a line is followed across the picture
_RATES = (1, 2, 4)


@dataclasses.dataclass(frozen=True)
class DeviceUNetConfig:
    """Channels of the input (the picture's and the segmenter's answers) and of each level."""

    channels: int = 6
    width: tuple[int, ...] = (16, 24, 48, 64)


class DeviceUNet(nn.Module):
    """(n, channels, rows, cols) to (n, 1, rows / 2, cols / 2): logits of device.

    Sides are divisible by 16.
    """

    def __init__(self, config: DeviceUNetConfig | None = None) -> None:
        super().__init__()
        self.config = config or DeviceUNetConfig()
        width = self.config.width
        # Half the resolution is enough to tell what a line is; 4 x 4 pixels keep its rims.
        self.stem = nn.Conv2d(self.config.channels, width[0], 4, stride=2, padding=1)
        self.down = nn.ModuleList(
            Pair(a, b) for a, b in zip((width[0], *width[:-1]), width, strict=True)
        )
        self.wide = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(width[-1], width[-1], 3, padding=rate, dilation=rate, bias=False),
                nn.GroupNorm(4, width[-1]),
            )
            for rate in _RATES
        )
        self.up = nn.ModuleList(
            Pair(a + b, b) for a, b in zip(width[:0:-1], width[-2::-1], strict=True)
        )
        self.head = nn.Conv2d(width[0], 1, 1)
        nn.init.constant_(self.head.bias, -3.0)  # devices are some 3 % of a picture

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return logits of catheter, lead or wire."""
        # Chords are up to 30 pixel edges.
        picture, chord, device = x.split([4, 1, self.config.channels - 5], dim=1)
        x = self.stem(torch.cat([picture, torch.log1p(chord), device], dim=1))
        kept = []
        for k, level in enumerate(self.down):
            x = level(x if k == 0 else functional.max_pool2d(x, 2))
            kept.append(x)
        for layer in self.wide:
            x = functional.relu(x + layer(x))
        for k, level in enumerate(self.up):
            x = functional.interpolate(x, scale_factor=2.0, mode="nearest")
            x = level(torch.cat([x, kept[-2 - k]], dim=1))
        logits: torch.Tensor = self.head(x)
        return logits
