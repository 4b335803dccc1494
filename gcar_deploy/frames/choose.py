"""Choose a frame of every run such that all show the heart in one phase."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from gcar_deploy.errors import GcarError
from gcar_deploy.frames.cine import Cine
from gcar_deploy.frames.masses import RunMasses, reduced, run_masses
from gcar_deploy.frames.pairs import choose_pair
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.chosen_frame import ChosenFrame, FramePair
from gcar_deploy.types import Image

#: runs of fewer frames show no heartbeat
LEAST_FRAMES = 4


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SeenRun:
    """A run with the C-arm that stood still for it, and what its grey values mean.

    ``kept``: number of a frame that was read, from 0 -> the frame, reduced.
    """

    cine: Cine
    carm: CArm
    intensity: Intensity
    kept: dict[int, Image] = dataclasses.field(default_factory=dict, repr=False)


def choose_frames(
    runs: Mapping[int, SeenRun], wanted: Mapping[int, int | None]
) -> dict[int, ChosenFrame]:
    """Choose frames of runs together; of those at rest, or too short, none.

    The first two runs in which anything moves choose a pair; every further one chooses the frame
    that goes with that of the first.

    Parameters
    ----------
    runs : number of the view, from 1 -> run
    wanted : number of the view -> frame that is asked for, from 1, None to choose

    Returns
    -------
    number of the view -> frame, for those that were to be chosen

    Raises
    ------
    ImageError
        A frame cannot be read.
    """
    able = [k for k in sorted(runs) if len(runs[k].cine) >= LEAST_FRAMES]
    if len(able) < 2 or all(wanted[k] is not None for k in able):
        return {}
    seen: dict[int, RunMasses] = {}
    for k in able:
        found = masses_of(runs[k])
        if found.beats:
            seen[k] = found
    out: dict[int, ChosenFrame] = {}
    if len(seen) < 2:
        return out
    first, *others = seen
    asked = wanted[first]
    for k in others:
        if wanted[k] is not None and asked is not None:
            continue
        pair = pair_of(runs[first], runs[k], seen[first], seen[k], (asked, wanted[k]))
        if wanted[first] is None and first not in out:
            out[first] = _chosen(pair, 0, runs[first], k)
            asked = out[first].number
        if wanted[k] is None:
            out[k] = _chosen(pair, 1, runs[k], first)
    return out


def masses_of(run: SeenRun, report: Callable[[float], None] | None = None) -> RunMasses:
    """Read all frames of a run and find the contrast in them."""
    small = reduced_frames(run, range(len(run.cine)), report)
    return run_masses(small, run.carm, run.intensity, run.cine.valid)


def reduced_frames(
    run: SeenRun, frames: range, report: Callable[[float], None] | None = None
) -> list[Image]:
    """Return frames of a run at the size that they are compared at, each read once."""
    for k in frames:
        if k not in run.kept:
            run.kept[k] = reduced(run.cine.decode(k))
        _told(report, k + 1 - frames.start, len(frames))
    return [run.kept[k] for k in frames]


def pair_of(
    first: SeenRun, second: SeenRun, a: RunMasses, b: RunMasses,
    wanted: tuple[int | None, int | None] = (None, None),
) -> FramePair:  # fmt: skip
    """Choose a pair of frames of two runs; see ``choose_pair`` (``wanted`` counts from 1 here)."""
    own, other = first.cine.frame_ms, second.cine.frame_ms
    i, j = (None if frame is None else frame - 1 for frame in wanted)
    return choose_pair(
        a, b, wanted=(i, j), r_waves=(first.cine.r_waves, second.cine.r_waves),
        ratio=own / other if own and other else 1.0,
    )  # fmt: skip


def stands_still(carm_of: Callable[[int], CArm], frames: int) -> bool:
    """Whether the C-arm stood still during a run, as far as its header tells."""
    try:
        P, Q = (carm_of(k).world2pixel for k in (0, frames - 1))
    except GcarError:
        return False
    return bool(np.allclose(P, Q, rtol=1e-6, atol=1e-6))


def _chosen(pair: FramePair, place: int, run: SeenRun, partner: int) -> ChosenFrame:
    own, other = pair.chosen[place] + 1, pair.chosen[1 - place] + 1
    margin = "" if pair.margin is None else f", margin {pair.margin:.2f}"
    return ChosenFrame(
        number=own, of=len(run.cine), pair=pair, partner=partner,
        reason=f"goes with frame {other} of view {partner} (score {pair.score:.2f}{margin})",
    )  # fmt: skip


def _told(report: Callable[[float], None] | None, done: float, of: int) -> None:
    if report is not None:
        report(done / of)
