"""Raw pictures of generated trees, as the segmenter's networks are trained on.

``generated_angiogram`` draws vessels in the plane and devices over anatomy of its own; here a tree
in space is seen by a clinical view, over ribs, spine and diaphragm, at any contrast and display.
"""

from __future__ import annotations

import numpy as np

from gcar_export.scenes.angiograms import FAINT, PERHAPS_PX, SURE_PX, GeneratedAngiogram, rim
from gcar_export.scenes.protocols import clinical_geometry
from gcar_export.scenes.raw_pictures import random_options, raw_picture
from gcar_export.scenes.render import path_lengths
from gcar_export.scenes.trees import SIDES, any_style, random_tree

#: standard deviation of each angle of a view, degrees
SPREAD_DEG = 12.0
#: an injection fills one artery: of ten trees so many show both. Where there is little vessel ribs
#: are the strongest lines, and a network that only ever saw both arteries took them for vessels
BOTH_OF_TEN = 2


def raw_angiogram(rng: np.random.Generator) -> GeneratedAngiogram:
    """Draw one, (512, 512) pixels."""
    tree = random_tree(rng, any_style(rng))
    if rng.integers(10) >= BOTH_OF_TEN:
        tree = tree.sides(SIDES[int(rng.integers(2))])
    carm = clinical_geometry(2)[0][int(rng.integers(2))].turned(*(SPREAD_DEG * rng.normal(size=2)))
    options = random_options(rng)
    path_mm = path_lengths(carm, *tree.segments())
    path_px = (path_mm / carm.pixel_at_isocenter_mm).astype(np.float32)
    mask = (path_px > SURE_PX) & (options.contrast_per_mm * path_mm > FAINT)
    return GeneratedAngiogram(
        pixels=raw_picture(path_mm, rng, options),
        mask=mask,
        unsure=(path_px > PERHAPS_PX) & ~rim(mask),
        device=np.zeros_like(mask),
        path_px=path_px,
        pixel_mm=carm.pixel_at_isocenter_mm,
    )
