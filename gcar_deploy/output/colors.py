"""Colours of branches and of a scale, which all kinds of colour vision tell apart."""

from __future__ import annotations

#: of Tol's and of Okabe and Ito's colours (red, green, blue), next ones far apart; none is near
#: the red of what no branch explains
_BRANCHES = (
    (238, 221, 136), (102, 204, 238), (170, 51, 119), (187, 204, 51),
    (255, 170, 187), (61, 143, 219), (213, 94, 0), (204, 121, 167),
)  # fmt: skip
#: both ends of a scale, blue to yellow and darker to lighter, and what is not known
SCALE, UNKNOWN = ((40, 110, 220), (253, 231, 37)), (255, 255, 255)


def branch_color(number: int) -> tuple[int, int, int]:
    """Return the colour (blue, green, red) of a branch, from 0; the same in every picture."""
    red, green, blue = _BRANCHES[number % len(_BRANCHES)]
    return blue, green, red


def css(color: tuple[int, int, int]) -> str:
    """Return a colour (red, green, blue) as pages write it."""
    return "rgb({},{},{})".format(*color)
