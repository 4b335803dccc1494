"""Words about a result that command line, overlay and report share."""

from __future__ import annotations

#: a smaller share that was left out of what looks like vessel goes without saying
LEAST_LEFT_OUT = 0.02
#: the grey of a picture: a line that the other views do not show may as well be a vessel
LEFT_OUT = "left out: catheter, wire, or vessel without a partner"
#: what the figure of a ghost means for a whole branch: a mean over its length
GHOST = "share of the branch expected more than 2 mm from any vessel"


def explained(coverage: float | None, even: float | None, left_out: float) -> str:
    """Say how much of a picture's vessels a tree explains, and what that share does not count.

    Length comes first: one thick vessel is most of the weight, whatever thin ones are missing.

    Parameters
    ----------
    coverage, even, left_out : ``coverage``, ``coverage_even`` and ``left_out`` of ``ViewQuality``;
        results of earlier versions lack ``even``
    """
    less = f"{left_out:.0%} of what looks like vessel was left out"
    notes = [less] if left_out > LEAST_LEFT_OUT else []
    weighed = "-" if coverage is None else f"{coverage:.0%}"
    if even is None:
        said = f"{weighed} of the vessels seen, weighed by thickness, is explained"
    else:
        said = f"{even:.0%} of the length of the vessels seen is explained"
        notes.insert(0, f"{weighed} weighed by thickness")
    return f"{said} ({'; '.join(notes)})" if notes else said
