"""Colours of branches and scales for eyes without one kind of cone."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.color import rgb2lab

from gcar_deploy.output.colors import SCALE, UNKNOWN, branch_color

#: what people without one kind of cone see, in linear RGB (Machado et al., IEEE Trans Vis Comput
#: Graph 15:1291, 2009, severity 1)
VISIONS = {
    "all cones": np.eye(3),
    "no red": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
               [-0.003882, -0.048116, 1.051998]],
    "no green": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
                 [-0.011820, 0.042940, 0.968881]],
    "no blue": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
                [0.004733, 0.691367, 0.303900]],
}  # fmt: skip


def lab(colors, vision):
    """(n, 3) CIE Lab of (n, 3) colours (red, green, blue) as such eyes see them."""
    rgb = np.array(colors) / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.array(VISIONS[vision]).T, 0, 1)
    return rgb2lab(np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055))


@pytest.mark.parametrize("vision", VISIONS)
def test_branches_are_apart_by_colour_for_everybody(vision):
    """CIE 1976 distance of the colours, the most of next numbers; 2.3 is just seen."""
    seen = lab([branch_color(k)[::-1] for k in range(8)], vision)
    gap = np.linalg.norm(seen[:, None] - seen[None], axis=-1)
    assert min(np.diag(np.roll(gap, -1, axis=1))) > 35
    assert gap[~np.eye(len(seen), dtype=bool)].min() > 15


@pytest.mark.parametrize("vision", VISIONS)
def test_halves_of_a_scale_are_apart_for_everybody(vision):
    """Lighter all the way, and what is not known is on no part of it."""
    shares = np.linspace(0, 1, 21)[:, None]
    low, high = map(np.array, SCALE)
    seen = lab(low + (high - low) * shares, vision)
    assert (np.diff(seen[:, 0]) > 0).all()
    assert min(np.linalg.norm(seen[10] - seen[end]) for end in (0, 20)) > 25
    assert np.linalg.norm(seen - lab([UNKNOWN], vision), axis=1).min() > 20
