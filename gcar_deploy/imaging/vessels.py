"""The vessels of all views, by whoever is asked for them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence

from gcar_deploy.beside import side_by_side
from gcar_deploy.config import ImagingOptions
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.extract import asked_network, extract_vessels
from gcar_deploy.imaging.net import Segmenter
from gcar_deploy.stopwatch import Stopwatch


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Vessels:
    """What is vessel in every view.

    Attributes
    ----------
    views : V vessel images
    segmenter : the network whose word is in a view, or None
    findings : reasons for ``degraded``
    """

    views: tuple[VesselImage, ...]
    segmenter: Segmenter | None
    findings: tuple[str, ...]


def find_vessels(
    angiograms: Sequence[Angiogram],
    options: ImagingOptions,
    segmenter: Segmenter | None,
    watch: Stopwatch,
    report: Callable[[float], None],
) -> Vessels:
    """Find the vessels of every view; see ``extract_vessels``.

    Parameters
    ----------
    angiograms : V pictures
    options, segmenter : as of ``extract_vessels``
    watch : Stopwatch, asked between the views and while the network runs
    report : told the share done

    Raises
    ------
    RefusedError, GeometryError
        As ``extract_vessels``.
    CancelledError
        Cancelled or late.
    """
    used, missing = asked_network(angiograms, options, segmenter)
    watched = used and used.watched(watch.question)

    def found(angiogram: Angiogram) -> VesselImage:
        watch.check()
        return extract_vessels(angiogram, options, watched)

    # Filters use one core each, and wait for each other where both ask the network.
    views = side_by_side([functools.partial(found, one) for one in angiograms])
    report(1.0)
    said = used if any(view.by_network for view in views) else None
    return Vessels(views=tuple(views), segmenter=said, findings=tuple(missing))
