"""The paper's Gaussian centre predictor: a U-Net from one picture to a map of centres.

H x W x 1 to (H/alpha) x (W/alpha) x 4: residual blocks with group normalisation and SiLU on each
level, as in the denoising U-Nets that the paper follows, a 1 x 1 head with four channels, average
pooling by alpha, then the activations that turn numbers into depth (sigmoid, 0 .. 1) and offset
(tanh, up to ``OFFSET_PIXELS``).
"""

from __future__ import annotations

import dataclasses

import torch
from torch import nn

from gcar_deploy.predict.center_map import OFFSET_PIXELS, OUTPUTS


@dataclasses.dataclass(frozen=True)
class UNetConfig:
    """Sizes of the network: the picture, its cells, and the channels of each level."""

    pixels: int = 128
    alpha: int = 2
    width: tuple[int, ...] = (8, 16, 32, 64, 96, 128)

    def __post_init__(self) -> None:
        if self.pixels % self.alpha or self.pixels % 2 ** (len(self.width) - 1):
            raise ValueError(
                f"pixels = {self.pixels} must be a multiple of alpha = {self.alpha} and of "
                f"2^{len(self.width) - 1}, one halving per level"
            )


class _Block(nn.Module):
    """Two normalised 3 x 3 convolutions beside a straight way."""

    def __init__(self, c_in: int, c_out: int) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(_groups(c_in), c_in)
        self.conv1 = nn.Conv2d(c_in, c_out, 3, padding=1)
        self.norm2 = nn.GroupNorm(_groups(c_out), c_out)
        self.conv2 = nn.Conv2d(c_out, c_out, 3, padding=1)
        self.straight = nn.Conv2d(c_in, c_out, 1) if c_in != c_out else nn.Identity()
        nn.init.zeros_(self.conv2.weight)
        nn.init.zeros_(self.conv2.bias)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, c_in, h, w) to (B, c_out, h, w)."""
        y = self.conv1(nn.functional.silu(self.norm1(x)))
        y = self.conv2(nn.functional.silu(self.norm2(y)))
        return self.straight(x) + y


class UNetPredictor(nn.Module):
    """From one picture to depth and offset per cell."""

    def __init__(self, config: UNetConfig | None = None) -> None:
        super().__init__()
        self.config = config or UNetConfig()
        w = self.config.width
        self.stem = nn.Conv2d(1, w[0], 3, padding=1)
        self.down = nn.ModuleList(
            [_Block(w[max(k - 1, 0)], w[k]) for k in range(len(w))],
        )
        self.middle = _Block(w[-1], w[-1])
        self.up = nn.ModuleList([_Block(w[k + 1] + w[k], w[k]) for k in range(len(w) - 1)])
        self.norm = nn.GroupNorm(_groups(w[0]), w[0])
        self.head = nn.Conv2d(w[0], OUTPUTS, 1)
        nn.init.normal_(self.head.weight, std=0.02)
        nn.init.zeros_(self.head.bias)

    def forward(self, picture: torch.Tensor) -> torch.Tensor:
        """(B, 1, n, n), 0 .. 1, to (B, 4, n/alpha, n/alpha): depth 0 .. 1, offsets in pixels."""
        x = self.stem(picture)
        skips = []
        for k, block in enumerate(self.down):
            x = block(nn.functional.avg_pool2d(x, 2) if k else x)
            skips.append(x)
        x = self.middle(x)
        for k in reversed(range(len(self.up))):
            x = nn.functional.interpolate(x, scale_factor=2.0, mode="nearest")
            x = self.up[k](torch.cat([x, skips[k]], dim=1))
        x = self.head(nn.functional.silu(self.norm(x)))
        x = nn.functional.avg_pool2d(x, self.config.alpha) if self.config.alpha > 1 else x
        x = x.float()
        return torch.cat([torch.sigmoid(x[:, :1]), OFFSET_PIXELS * torch.tanh(x[:, 1:])], dim=1)


def _groups(channels: int) -> int:
    """Return the most groups, up to 8, of at least 4 channels each."""
    return next(g for g in (8, 4, 2, 1) if channels % g == 0 and (channels // g >= 4 or g == 1))
