"""Models of a user's own in the rows of an evaluation, in place of those that come along."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path

from gcar_deploy.config import RunOptions


@dataclasses.dataclass(frozen=True, kw_only=True)
class OwnModels:
    """ONNX files with their specs beside them; None for what comes along.

    Attributes
    ----------
    predictor : asked by the rows whose predictor is of its kind, and by those that leave it open
    segmenter : asked by all rows of the runtime that find vessels by a network
    """

    predictor: Path | None = None
    segmenter: Path | None = None

    def used(self, options: RunOptions) -> OwnModels:
        """Return those that a run with these options asks.

        Raises
        ------
        ModelError
            The predictor is missing, altered, or none.
        """
        kinds = ("auto",) if self.predictor is None else ("auto", _kind(self.predictor))
        asked = options.predict.predictor in kinds
        classic = options.imaging.segmenter == "classic"
        return OwnModels(
            predictor=self.predictor if asked else None,
            segmenter=None if classic else self.segmenter,
        )

    @property
    def files(self) -> tuple[Path, ...]:
        """Those that there are."""
        return tuple(path for path in (self.predictor, self.segmenter) if path is not None)

    def said(self) -> str:
        """Name each file, with the beginning of its SHA-256; empty without any."""
        return ", ".join(f"{path.name} ({sha256(path)[:12]})" for path in self.files)


def sha256(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _kind(path: Path) -> str:
    from gcar_deploy.predict.kinds import read_predictor

    return read_predictor(path).kind
