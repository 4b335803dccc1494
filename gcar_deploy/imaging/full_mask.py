"""Pictures declared as masks that cannot be masks of coronary arteries: far too much is vessel."""

from __future__ import annotations

from gcar_deploy.errors import RefusedError
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.types import Mask

#: share of a picture that vessels may fill: real and generated masks have 2 .. 11 %
MOST_VESSEL = 0.35
#: share of a picture that may be neither dark nor bright: of a mask its soft edges are, of most
#: X-ray pictures with as little above half three quarters
MOST_GREY = 0.5
#: of the largest value: what is between them is neither
_DARK, _BRIGHT = 0.25, 0.75


def refuse_full(angiogram: Angiogram, above: Mask) -> None:
    """Refuse an X-ray picture, or an inverted mask, that is declared as kind ``mask``.

    Parameters
    ----------
    angiogram : Angiogram
    above : (rows, cols), where it is above half of its largest value

    Raises
    ------
    RefusedError
        More of it is vessel, or grey, than of any mask.
    """
    share, level = float(above.mean()), angiogram.pixels / angiogram.pixels.max()
    grey = float(((level > _DARK) & (level < _BRIGHT)).mean())
    if share > MOST_VESSEL:
        why = (
            f"{share:.0%} of the picture are above half of the largest value "
            f"(at most {MOST_VESSEL:.0%} can be vessel)"
        )
    elif grey > MOST_GREY:
        why = f"{grey:.0%} of the picture are neither dark nor bright"
    else:
        return
    raise RefusedError(
        f"{angiogram.label}: intensity.kind is mask, but {why}; is it an X-ray picture (kind raw), "
        "or a mask drawn dark on bright (invert it)?"
    )
