"""Adam (Kingma and Ba 2015) on a dictionary of arrays, with state that follows its rows."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gcar_deploy.types import Array

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-12


class Adam:
    """Moments per named parameter; each has its own learning rate."""

    def __init__(self, rates: Mapping[str, float]) -> None:
        self.rates = dict(rates)
        self.steps = 0
        self._first: dict[str, Array] = {}
        self._second: dict[str, Array] = {}

    def step(self, gradients: Mapping[str, Array], factor: float = 1.0) -> dict[str, Array]:
        """Return what to add to each parameter; ``factor`` scales all rates."""
        self.steps += 1
        out = {}
        for name, g in gradients.items():
            m = self._first.get(name, np.zeros_like(g))
            v = self._second.get(name, np.zeros_like(g))
            m = BETA1 * m + (1 - BETA1) * g
            v = BETA2 * v + (1 - BETA2) * g * g
            self._first[name], self._second[name] = m, v
            m_hat = m / (1 - BETA1**self.steps)
            v_hat = v / (1 - BETA2**self.steps)
            out[name] = -factor * self.rates[name] * m_hat / (np.sqrt(v_hat) + EPSILON)
        return out

    def restart(self) -> None:
        """Forget the moments: the rows now mean other Gaussians."""
        self.steps = 0
        self._first.clear()
        self._second.clear()
