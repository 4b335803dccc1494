"""What a covariance in space says as one number."""

from __future__ import annotations

import numpy as np

from gcar_deploy.types import Array


def worst_sigma(covariance: Array) -> Array:
    """(...) standard deviation in the direction where it is largest, mm, of (..., 3, 3) mm^2."""
    largest: Array = np.linalg.eigvalsh(covariance)[..., -1]
    return np.sqrt(np.maximum(largest, 0.0))
