"""What projects Gaussians and pulls gradients back: NumPy, numba, or torch on CPU or GPU.

Numba runs NumPy's sums as compiled loops. Torch is dense and differentiates itself; NumPy cuts each
Gaussian off at four standard deviations, beyond which 3e-4 of its peak lies. Pictures agree within
``PICTURE_TOLERANCE`` of their peak, gradients within ``GRADIENT_TOLERANCE`` of their norm.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from gcar_deploy.config import BACKENDS, DEVICES
from gcar_deploy.config.ranges import check_choice
from gcar_deploy.errors import UsageError
from gcar_deploy.gaussians.gaussians import Gaussians
from gcar_deploy.gaussians.project import Gradient, project, project_vjp
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.types import Array

#: stated agreement of the two backends in float64
PICTURE_TOLERANCE = 2e-3
GRADIENT_TOLERANCE = 5e-3


@dataclasses.dataclass(frozen=True)
class Backend:
    """A projector and its vector-Jacobian product; see ``project`` and ``project_vjp``."""

    project: Callable[[Gaussians, CArm], Array]
    vjp: Callable[[Gaussians, CArm, Array], Gradient]


def backend_named(name: str, device: str = "cpu") -> Backend:
    """Return a backend.

    Raises
    ------
    UsageError
        Unknown, on a device it has not, or not installed.
    """
    check_choice("backend", name, BACKENDS)
    check_choice("device", device, DEVICES)
    if name == "numpy":
        if device != "cpu":
            raise UsageError(f"device {device} needs the backend torch; numpy runs on cpu")
        return Backend(project=project, vjp=project_vjp)
    if name == "numba":
        if device != "cpu":
            raise UsageError(f"device {device} needs the backend torch; numba runs on cpu")
        from gcar_deploy.gaussians import numba_project

        numba_project.check_numba()
        return Backend(project=numba_project.project_compiled, vjp=numba_project.vjp_compiled)
    from gcar_deploy.gaussians import torch_project as twin

    twin.check_device(device)
    return Backend(
        project=lambda g, carm: twin.project_arrays(g, carm, device),
        vjp=lambda g, carm, grad: twin.vjp_arrays(g, carm, grad, device),
    )
