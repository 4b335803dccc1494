"""Generated angiograms that are drawn once, kept in a folder and used by every run."""

from __future__ import annotations

import functools
import hashlib
import os
from pathlib import Path

import numpy as np

from gcar_export.scenes import (
    angiogram_scenery,
    angiogram_vessels,
    angiograms,
    raw_pictures,
    render,
    trees,
)
from gcar_export.scenes.angiograms import asked_of, generated_angiogram
from gcar_export.scenes.augmented import Labelled

#: enlargement of a crop
ZOOM = (0.9, 1.3)
_MAKERS = (angiogram_scenery, angiogram_vessels, angiograms, raw_pictures, render, trees)


@functools.cache
def generator() -> str:
    """Return a hash of the code that draws: pictures of another are none of this pool."""
    texts = [Path(str(module.__file__)).read_bytes() for module in _MAKERS]
    return hashlib.sha256(b"".join(texts)).hexdigest()[:12]


def pooled(folder: Path, seed: int, index: int) -> Labelled:
    """Picture ``index`` of the stream ``seed``; drawn where the folder does not hold it yet."""
    path = folder / f"{generator()}-{seed}-{index:06d}.npz"
    if not path.exists():
        made = generated_angiogram(seed, index)
        folder.mkdir(parents=True, exist_ok=True)
        asked = asked_of(made).astype(np.float16)
        part = path.with_suffix(f".{os.getpid()}.tmp")
        with part.open("wb") as file:
            np.savez_compressed(file, pixels=made.pixels, asked=asked)
        part.replace(path)
    with np.load(path) as data:
        return Labelled(data["pixels"], data["asked"].astype(np.float32), ZOOM)
