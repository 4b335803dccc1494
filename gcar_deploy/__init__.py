"""Coronary arteries in 3D from two or more X-ray angiograms. Research use only.

    from gcar_deploy import Engine
    result = Engine().reconstruct(["view1.png", "view2.png"], "geom.json")
    result.save("result")

Names are loaded when they are first used, so that ``import gcar_deploy`` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gcar_deploy.config import RunOptions
    from gcar_deploy.engine import Engine
    from gcar_deploy.errors import CancelledError, GcarError
    from gcar_deploy.geometry.carm import CArm
    from gcar_deploy.geometry.grid import Grid
    from gcar_deploy.geometry.scene import Scene, load_scene
    from gcar_deploy.imaging.angiogram import Angiogram
    from gcar_deploy.inputs.order import Order, load_order
    from gcar_deploy.result import Result

__all__ = [
    "Angiogram",
    "CArm",
    "CancelledError",
    "Engine",
    "GcarError",
    "Grid",
    "Order",
    "Result",
    "RunOptions",
    "Scene",
    "load_order",
    "load_scene",
]

_HOMES = {
    "Angiogram": "gcar_deploy.imaging.angiogram",
    "CArm": "gcar_deploy.geometry.carm",
    "CancelledError": "gcar_deploy.errors",
    "Engine": "gcar_deploy.engine",
    "GcarError": "gcar_deploy.errors",
    "Grid": "gcar_deploy.geometry.grid",
    "Order": "gcar_deploy.inputs.order",
    "Result": "gcar_deploy.result",
    "RunOptions": "gcar_deploy.config",
    "Scene": "gcar_deploy.geometry.scene",
    "load_order": "gcar_deploy.inputs.order",
    "load_scene": "gcar_deploy.geometry.scene",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("gcar")
    if name not in _HOMES:
        raise AttributeError(f"module 'gcar_deploy' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
