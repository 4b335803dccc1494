"""The paper's refinement loss: projection L2 and L2 on the projected centreline.

L_G = sum over views of alpha ||P^ - P||^2 + (1 - alpha) ||(P^ - P) M_cl||^2 (3DGR-CAR, eq. 3), both
norms as sums over pixels, as printed: at alpha = 0.5 a pixel of the skeleton weighs twice another.
"""

from __future__ import annotations

import numpy as np

from gcar_deploy.types import Array, Image, Mask


def projection_loss(
    made: Array, picture: Image, skeleton: Mask, valid: Mask, alpha: float
) -> tuple[float, Array]:
    """Loss of one view and its gradient by the picture made.

    Parameters
    ----------
    made, picture : (rows, cols) path length, mm
    skeleton : (rows, cols) M_cl
    valid : (rows, cols) pixels that carry a picture; the others pull at nothing
    alpha : 1 for plain L2

    Returns
    -------
    loss : mm^2
    gradient : (rows, cols) mm
    """
    r = np.asarray(made, dtype=np.float64) - picture
    weight = np.where(valid, alpha + (1.0 - alpha) * skeleton, 0.0)
    return float(np.sum(weight * r * r)), 2.0 * weight * r
