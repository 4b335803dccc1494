"""Generated angiograms that are drawn once, kept in a folder and used by every run.

Of each two one is a raw picture of a tree in space (``raw_angiograms``), one is drawn in the plane
(``angiograms``).
"""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path

import numpy as np

from gcar_deploy.files import whole_file
from gcar_export.scenes import (
    angiogram_scenery,
    angiogram_vessels,
    angiograms,
    raw_angiograms,
    raw_pictures,
    render,
    trees,
)
from gcar_export.scenes.angiograms import GeneratedAngiogram, asked_of, generated_angiogram
from gcar_export.scenes.augmented import Labelled
from gcar_export.scenes.raw_angiograms import raw_angiogram

#: enlargement of a crop, and of a raw picture's, which is twice as fine
ZOOM, RAW_ZOOM = (0.9, 1.3), (0.62, 1.0)
RAW_EVERY = 2
_MAKERS = (
    angiogram_scenery,
    angiogram_vessels,
    angiograms,
    raw_angiograms,
    raw_pictures,
    render,
    trees,
)


@functools.cache
def generator() -> str:
    """Return a hash of the code that draws: pictures of another are none of this pool."""
    texts = [Path(str(module.__file__)).read_bytes() for module in _MAKERS]
    return hashlib.sha256(b"".join(texts)).hexdigest()[:12]


def pooled(folder: Path, seed: int, index: int) -> Labelled:
    """Picture ``index`` of the stream ``seed``; drawn where the folder does not hold it yet."""
    path = folder / f"{generator()}-{seed}-{index:06d}.npz"
    if not path.exists():
        made = drawn(seed, index)
        folder.mkdir(parents=True, exist_ok=True)
        asked = asked_of(made).astype(np.float16)
        with whole_file(path) as part, part.open("wb") as file:
            np.savez_compressed(file, pixels=made.pixels, asked=asked)
    with np.load(path) as data:
        asked, fine = data["asked"].astype(np.float32), index % RAW_EVERY == 0
        return Labelled(data["pixels"], asked, RAW_ZOOM if fine else ZOOM)


def drawn(seed: int, index: int) -> GeneratedAngiogram:
    """Picture ``index`` of the stream ``seed``, drawn anew."""
    if index % RAW_EVERY:
        return generated_angiogram(seed, index)
    return raw_angiogram(np.random.default_rng([seed, index]))
