"""Which engine does the work, in plain values: for a command, and for processes of a batch."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gcar_deploy.engine import Engine
    from gcar_deploy.inputs.order import Order


@dataclasses.dataclass(frozen=True)
class EngineChoice:
    """Which engine does the work: model files (None for the shipped ones) and threads."""

    model: Path | None = None
    threads: int | None = None
    segmenter_model: Path | None = None

    @property
    def files(self) -> dict[str, Path]:
        """Return the model files that are named, each by its role."""
        named = {"model": self.model, "segmenter_model": self.segmenter_model}
        return {role: file for role, file in named.items() if file is not None}

    def absolute(self) -> EngineChoice:
        """Return the choice with its files by their full paths."""
        full = {role: file.absolute() for role, file in self.files.items()}
        return EngineChoice(full.get("model"), self.threads, full.get("segmenter_model"))

    def limit_threads(self) -> None:
        """Hold every numerical library of this process; before they are imported."""
        if self.threads is None:
            return
        for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
            os.environ[name] = str(self.threads)
        import cv2

        cv2.setNumThreads(self.threads)

    def engine(self, order: Order) -> Engine:
        """Return an engine set up as an order chooses."""
        from gcar_deploy.config import RunOptions
        from gcar_deploy.engine import Engine

        options = order.options(RunOptions())
        return Engine(
            self.model,
            threads=self.threads,
            options=options,
            segmenter_model=self.segmenter_model,
        )
