"""The mean of a network's weights over its last steps.

Single steps of a few scenes each leave noise in the weights; their mean has less of it and decides
better than any of them (Polyak and Juditsky, SIAM J Control Optim 30:838, 1992).
"""

from __future__ import annotations

import copy
from typing import Generic, TypeVar

import torch

N = TypeVar("N", bound=torch.nn.Module)


class MeanWeights(Generic[N]):
    """An exponential mean that begins as the plain one.

    Parameters
    ----------
    net : the network that is trained; it is left as it is
    steps : time constant of the mean
    """

    def __init__(self, net: N, steps: int) -> None:
        if steps < 1:
            raise ValueError(f"steps = {steps} must be at least 1")
        self.net: N = copy.deepcopy(net).requires_grad_(False)
        self.steps = steps

    @torch.no_grad()
    def add(self, net: N, step: int) -> None:
        """Take in the weights after ``step`` steps (from 1)."""
        share = max(1.0 / step, 1.0 / self.steps)
        own = self.net.state_dict()
        for name, value in net.state_dict().items():
            own[name].lerp_(value, share)
