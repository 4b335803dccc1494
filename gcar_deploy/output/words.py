"""Words about a result that command line, overlay and report share."""

from __future__ import annotations

#: a smaller share that was left out of what looks like vessel goes without saying
LEAST_LEFT_OUT = 0.02
#: the grey of a picture: a line that the other views do not show may as well be a vessel
LEFT_OUT = "left out: catheter, wire, or vessel without a partner"


def explained(coverage: float | None, left_out: float) -> str:
    """Say how much of a picture's vessels a tree explains, and what that share does not count.

    Parameters
    ----------
    coverage, left_out : as of ``ViewQuality``
    """
    share = "-" if coverage is None else f"{coverage:.0%}"
    less = f" ({left_out:.0%} of what looks like vessel was left out)"
    return f"{share} of the vessels seen are explained{less if left_out > LEAST_LEFT_OUT else ''}"
