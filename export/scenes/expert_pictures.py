"""Real angiograms with the vessels as an expert drew them: folds, and crops to train on.

A folder holds ``N.png`` with ``N_gt.png``. What an expert draws has no depth and no catheter: the
chord is that of round vessels, and of devices is known where none is: on vessels.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gcar_deploy.errors import ImageError
from gcar_deploy.imaging.mask_path import mask_path
from gcar_deploy.imaging.net import SIDE as NETWORK_SIDE
from gcar_deploy.imaging.read import read_picture
from gcar_deploy.types import Array, Image, Mask
from gcar_export.scenes.augmented import Labelled, augmented_pair

#: pixels of a crop for one of the picture at the network's size
ZOOM = (0.75, 1.6)
#: experts draw within the shadow: a network that learned chords from their widths alone gave some
#: such share of the true ones in raw pictures of generated trees
DRAWN_SHARE = 0.6
#: so many pictures are named one by one: manifests and specs are bounded
MOST_NAMED = 150
#: a mask of more values than two is vessel above this one, half of 8 bits
HALF_GREY = 127
#: vessels cover no more than this share of a picture: what does is ground, or the wrong way round
MOST_DRAWN = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class ExpertPicture:
    """One real angiogram.

    Attributes
    ----------
    name : str
    pixels : (rows, cols) float32, grey values, vessels dark
    mask : (rows, cols) bool, vessels as drawn
    path_px : (rows, cols) float32, chords of round vessels that are drawn so wide, pixel edges
    """

    name: str
    pixels: Image
    mask: Mask
    path_px: Image

    @functools.cached_property
    def labelled(self) -> Labelled:
        """The picture with what is asked: of devices, that no vessel is one."""
        ones = np.ones_like(self.path_px)
        layers = [self.mask, ones, self.path_px, 0 * ones, self.mask, 0 * ones]
        scale = NETWORK_SIDE / float(np.sqrt(self.mask.size))
        asked = np.stack(layers).astype(np.float32)
        return Labelled(self.pixels, asked, (scale * ZOOM[0], scale * ZOOM[1]))


def expert_pictures(folder: Path) -> tuple[ExpertPicture, ...]:
    """Read a folder's pictures, in the order of their numbers.

    Raises
    ------
    ImageError
        No picture with a mask of the same size; a mask that is none.
    """
    paths = sorted(folder.glob("*_gt.png"), key=lambda p: (len(p.name), p.name))
    found = []
    for path in paths:
        name = path.name.removesuffix("_gt.png")
        pixels, mask = read_picture(path.with_name(f"{name}.png"))[0], expert_mask(path)
        if pixels.shape != mask.shape:
            raise ImageError(f"{path}: {mask.shape} pixels, but its picture has {pixels.shape}")
        chord = mask_path(mask, 1.0) / np.float32(DRAWN_SHARE)
        found.append(ExpertPicture(name, pixels, mask, chord))
    if not found:
        raise ImageError(f"{folder}: no N.png with N_gt.png")
    return tuple(found)


def expert_mask(path: Path) -> Mask:
    """Read where an expert drew vessels, (rows, cols) bool.

    Of two values (0 and 1, 0 and 255, whatever they are) the larger one is vessel; of more values
    those above ``HALF_GREY``.

    Raises
    ------
    ImageError
        It is no picture; nothing is drawn in it, or nearly everything.
    """
    grey = read_picture(path, binary=True)[0]
    low, high = float(grey.min()), float(grey.max())
    two = bool(((grey == low) | (grey == high)).all())
    mask = grey > (low if two else HALF_GREY)
    share = float(mask.mean())
    if not share:
        said = (
            f"every pixel is {low:g}"
            if two
            else f"of more than two values none is above {HALF_GREY}"
        )
        raise ImageError(f"{path}: nothing is drawn in it: {said}")
    if share > MOST_DRAWN:
        raise ImageError(
            f"{path}: {share:.0%} of it is drawn as vessel; vessels are the larger value"
        )
    return mask


def named(folder: Path, pictures: Sequence[ExpertPicture]) -> dict[str, str]:
    """Return name -> SHA-256 of N.png followed by N_gt.png; one entry where they are very many."""
    found = {}
    for one in pictures:
        digest = hashlib.sha256((folder / f"{one.name}.png").read_bytes())
        digest.update((folder / f"{one.name}_gt.png").read_bytes())
        found[one.name] = digest.hexdigest()
    if len(found) <= MOST_NAMED:
        return found
    lines = "".join(f"{digest}  {name}\n" for name, digest in found.items())
    whole = hashlib.sha256(lines.encode()).hexdigest()
    return {f"{len(found)} pictures of {folder.name}": whole}


def fold_edges(count: int, of: int) -> Array:
    """(of + 1,) int: where each of ``of`` runs of neighbours begins, and the end of the last."""
    return np.linspace(0, count, of + 1).round().astype(int)


def folds(
    pictures: Sequence[ExpertPicture], number: int, of: int
) -> tuple[tuple[ExpertPicture, ...], tuple[ExpertPicture, ...]]:
    """Return what fold ``number`` (1 .. ``of``) trains on, and what it leaves out.

    Folds are runs of neighbours: frames of one patient stand beside each other.
    """
    edges = fold_edges(len(pictures), of)
    low, high = edges[number - 1], edges[number]
    return tuple(pictures[:low]) + tuple(pictures[high:]), tuple(pictures[low:high])


def expert_pair(
    pictures: Sequence[ExpertPicture], seed: int, index: int
) -> tuple[Array, Array, int]:
    """Return input and truth of a crop, as ``augmented.augmented_pair``, and of which picture."""
    rng = np.random.default_rng([seed, index, 3])
    number = int(rng.integers(len(pictures)))
    return *augmented_pair(rng, pictures[number].labelled), number
