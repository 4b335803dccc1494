"""Result: a reconstruction that can be written to a folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from gcar_deploy.errors import UsageError
from gcar_deploy.files import path_of
from gcar_deploy.reconstruction import Reconstruction


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Result(Reconstruction):
    """What ``Engine.reconstruct`` returns; see ``Reconstruction`` for its attributes."""

    @classmethod
    def of(cls, found: Reconstruction, notes: Sequence[str]) -> Result:
        """Take over a reconstruction, with other notes."""
        fields = {f.name: getattr(found, f.name) for f in dataclasses.fields(found)}
        return cls(**{**fields, "notes": tuple(notes)})

    def save(self, out_dir: str | Path, *, force: bool = False, extras: Sequence[str] = ()) -> Path:
        """Write the result folder, all or nothing; see ``output.bundle``.

        Parameters
        ----------
        force : replace a folder that this program wrote
        extras : of ``glb`` (surface.glb) and ``dicom-stl`` (surface.dcm)
        """
        # Whoever does not save need not load what only writers need.
        from gcar_deploy.output.bundle import write_result

        folder = path_of(out_dir, "out_dir", UsageError)
        return write_result(self, folder, force=force, extras=extras)
