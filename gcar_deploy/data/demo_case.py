"""The demo case: a patient's left coronary tree seen in two simulated clinical views."""

from __future__ import annotations

import dataclasses
from importlib import resources
from pathlib import Path

import numpy as np

from gcar_deploy.types import Points, Volume


@dataclasses.dataclass(frozen=True, kw_only=True)
class DemoCase:
    """Files of the case and the truth behind them.

    Attributes
    ----------
    pictures : paths of the two views (16-bit PNG, path lengths)
    geometry : path of geom.json
    truth_file : path of the truth
    """

    pictures: tuple[Path, ...]
    geometry: Path
    truth_file: Path

    def truth(self) -> Volume:
        """(nx, ny, nz) float32 share of each voxel inside the vessels, on the case's grid."""
        with np.load(self.truth_file, allow_pickle=False) as stored:
            volume = np.zeros(tuple(stored["shape"]), np.float32)
            volume.reshape(-1)[stored["voxel"]] = stored["share"] / np.float32(255)
        return volume

    def centreline_mm(self) -> Points:
        """(n, 3) points of the true centreline, mm LPS."""
        with np.load(self.truth_file, allow_pickle=False) as stored:
            return stored["centreline_mm"].astype(np.float64)


def demo_case() -> DemoCase:
    """Return the case that is installed with the package."""
    folder = Path(str(resources.files("gcar_deploy.data"))) / "demo"
    return DemoCase(
        pictures=(folder / "view1.png", folder / "view2.png"),
        geometry=folder / "geom.json",
        truth_file=folder / "truth.npz",
    )
