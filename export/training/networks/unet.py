"""The paper's Gaussian centre predictor: a U-Net from one picture to a map of centres.

H x W x 1 to (H/alpha) x (W/alpha) x 4: residual blocks with group normalisation and SiLU on each
level, as in the denoising U-Nets that the paper follows, a 1 x 1 head with four channels, average
pooling by alpha, then the activations that turn numbers into depth (sigmoid, 0 .. 1) and offset
(tanh, up to ``OFFSET_PIXELS``). Where in the picture a pixel lies says much about its depth, so
row and column join the picture as constants, and the coarsest level has a learned map of its own.
The finest level, whose features are averaged at the end, has one convolution each way and no
normalisation: a block there costs as much as all coarser ones together.

One network serves all views: with ``pose`` the axes of the view enter each block where a denoising
U-Net takes its noise level. For the paper's two fixed views they say no more than which it is.
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
    #: tell the network from where the picture was taken; without, it sees the picture alone
    pose: bool = False

    def __post_init__(self) -> None:
        if self.pixels % self.alpha or self.pixels % 2 ** (len(self.width) - 1):
            raise ValueError(
                f"pixels = {self.pixels} must be a multiple of alpha = {self.alpha} and of "
                f"2^{len(self.width) - 1}, one halving per level"
            )


#: width of the embedded pose
POSE_WIDTH = 48


class _Block(nn.Module):
    """Two normalised 3 x 3 convolutions beside a straight way; the pose shifts and scales."""

    def __init__(self, c_in: int, c_out: int, pose: bool) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(_groups(c_in), c_in)
        self.conv1 = nn.Conv2d(c_in, c_out, 3, padding=1)
        self.norm2 = nn.GroupNorm(_groups(c_out), c_out)
        self.conv2 = nn.Conv2d(c_out, c_out, 3, padding=1)
        self.straight = nn.Conv2d(c_in, c_out, 1) if c_in != c_out else nn.Identity()
        nn.init.zeros_(self.conv2.weight)
        nn.init.zeros_(self.conv2.bias)
        self.told = nn.Linear(POSE_WIDTH, 2 * c_out) if pose else None

    def forward(self, x: torch.Tensor, pose: torch.Tensor | None) -> torch.Tensor:
        """(B, c_in, h, w) and (B, POSE_WIDTH) to (B, c_out, h, w)."""
        y = self.norm2(self.conv1(nn.functional.silu(self.norm1(x))))
        if self.told is not None:
            scale, shift = self.told(pose)[:, :, None, None].chunk(2, dim=1)
            y = y * (1 + scale) + shift
        y = self.conv2(nn.functional.silu(y))
        return self.straight(x) + y


class UNetPredictor(nn.Module):
    """From one picture to depth and offset per cell."""

    def __init__(self, config: UNetConfig | None = None) -> None:
        super().__init__()
        self.config = config or UNetConfig()
        w = self.config.width
        n = self.config.pixels
        self.stem = nn.Conv2d(3, w[0], 3, padding=1)
        p = self.config.pose
        self.pose = (
            nn.Sequential(nn.Linear(9, POSE_WIDTH), nn.SiLU(), nn.Linear(POSE_WIDTH, POSE_WIDTH))
            if p
            else None
        )
        self.down = nn.ModuleList([_Block(w[k - 1], w[k], p) for k in range(1, len(w))])
        self.place = nn.Parameter(torch.zeros(1, w[-1], *(2 * (n >> (len(w) - 1),))))
        self.middle = _Block(w[-1], w[-1], p)
        self.up = nn.ModuleList([_Block(w[k + 1] + w[k], w[k], p) for k in range(1, len(w) - 1)])
        self.narrow = nn.Conv2d(w[1], w[0], 1)
        self.finest = nn.Conv2d(w[0], w[0], 3, padding=1)
        self.head = nn.Conv2d(w[0], OUTPUTS, 1)
        nn.init.normal_(self.head.weight, std=0.02)
        nn.init.zeros_(self.head.bias)
        axis = torch.linspace(-1, 1, n)
        where = torch.stack(torch.meshgrid(axis, axis, indexing="ij"))[None]
        self.register_buffer("where", where, persistent=False)

    def forward(self, picture: torch.Tensor, axes: torch.Tensor | None = None) -> torch.Tensor:
        """Predict depth 0 .. 1 and offsets in pixels, (B, 4, n/alpha, n/alpha).

        Takes (B, 1, n, n), 0 .. 1, and with ``config.pose`` the (B, 3, 3) axes u, v, d of the view.
        """
        told = None if self.pose is None else self.pose(axes.reshape(-1, 9))
        where = self.where.expand(picture.shape[0], -1, -1, -1)
        x = self.stem(torch.cat([picture, where], dim=1))
        skips = [x]
        for block in self.down:
            x = block(nn.functional.avg_pool2d(x, 2), told)
            skips.append(x)
        x = self.middle(x + self.place, told)
        for k in reversed(range(len(self.up))):
            x = nn.functional.interpolate(x, scale_factor=2.0, mode="nearest")
            x = self.up[k](torch.cat([x, skips[k + 1]], dim=1), told)
        x = nn.functional.interpolate(self.narrow(x), scale_factor=2.0, mode="nearest") + skips[0]
        x = self.head(nn.functional.silu(self.finest(nn.functional.silu(x))))
        x = nn.functional.avg_pool2d(x, self.config.alpha) if self.config.alpha > 1 else x
        x = x.float()
        return torch.cat([torch.sigmoid(x[:, :1]), OFFSET_PIXELS * torch.tanh(x[:, 1:])], dim=1)


def _groups(channels: int) -> int:
    """Return the most groups, up to 8, of at least 4 channels each."""
    return next(g for g in (8, 4, 2, 1) if channels % g == 0 and (channels // g >= 4 or g == 1))
