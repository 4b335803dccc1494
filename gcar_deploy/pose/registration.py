"""Registration of the views to each other: what ``run`` and ``validate`` both ask before a tree."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Sequence

from gcar_deploy.config import Landmark, RunOptions
from gcar_deploy.errors import RefusedError
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.pose.agreement import agreeing, order_of, scale_hint, with_motion
from gcar_deploy.pose.bundling import TreeOf, bundled, posed
from gcar_deploy.pose.pairwise import Pose, worst_of
from gcar_deploy.pose.significance import asked
from gcar_deploy.quality import check_asked, check_consistency, check_motion, check_poses, with_hint

#: places where vessels turn and end contradict each other from here on (root mean square), mm. Of
#: generated pictures of two patients with this rule: 0.48 to 0.83; of one patient: 0.3
LEAST_CONTRADICTION_MM = 0.4
#: landmarks mark one place where their rays pass so near, mm: a click is off by a pixel or two, and
#: the heart moves by some mm between the runs
LANDMARKS_APART_MM = 5.0


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Registered:
    """Views where they stand to each other.

    Attributes
    ----------
    views : V vessel images with their corrections built in, the motion of the heart undone; of
        raw pictures at times only what agrees of each
    poses : the corrections, one per view, the first of them zero
    findings : reasons for ``degraded``
    hint : what a refusal should say as well; mostly empty
    refusal : why the views cannot show one tree; empty where they can
    drawn : strokes and marks of the user, which a refusal should name; empty without any
    """

    views: tuple[VesselImage, ...]
    poses: tuple[Pose, ...]
    findings: tuple[str, ...]
    hint: str
    refusal: str
    drawn: str = ""

    @property
    def disagreement(self) -> float:
        """Worst disagreement of a view with its partner after the corrections, 0 .. 1."""
        return worst_of(self.poses)

    def pictures(self, angiograms: Sequence[Angiogram]) -> list[Angiogram]:
        """Return the pictures as the views show them: with the motion of the heart undone."""
        return [pose.still(a) for a, pose in zip(angiograms, self.poses, strict=True)]

    def marks(self, options: RunOptions) -> RunOptions:
        """Return the options with what a person marked where the views show it now."""

        def moved(marks: Sequence[Landmark]) -> tuple[Landmark, ...]:
            return tuple(
                tuple(
                    point and pose.still_at(view.carm, point)
                    for point, pose, view in zip(mark, self.poses, self.views, strict=True)
                )
                for mark in marks
            )

        if all(pose.motion is None for pose in self.poses):
            return options
        return dataclasses.replace(
            options, same_branch=moved(options.same_branch), ostia=moved(options.ostia)
        )

    def or_refuse(self) -> None:
        """Raise RefusedError where the views contradict each other."""
        if self.refusal:
            with with_hint("", self.drawn):
                raise RefusedError(self.refusal)

    def hinting(self) -> contextlib.AbstractContextManager[None]:
        """Let a refusal of a later stage name what was drawn, and say the hint as well."""
        return with_hint(self.hint, self.drawn)


def register(
    angiograms: Sequence[Angiogram],
    views: Sequence[VesselImage],
    options: RunOptions,
    tree_of: TreeOf,
    check: Callable[[], None] | None = None,
) -> Registered:
    """Estimate where the views stand, and judge whether they can show one tree.

    Parameters
    ----------
    angiograms : V pictures as they were given
    views : what was found in them, V
    options : RunOptions
    tree_of : makes a quick tree of views that have their corrections built in; asked only for
        three and more views that do not agree as they are told
    check : raises where the caller wants out; asked between estimates

    Returns
    -------
    Registered
        Also of views that contradict each other: ``or_refuse`` raises then.
    """
    given = views
    views, poses, findings = agreeing(angiograms, given, options, check)
    rigid = bundled(views, poses, tree_of, options)
    order, hint = order_of(views, rigid, options)
    findings += order
    hint = hint or scale_hint(views, rigid, options)
    # Pictures that are swapped, or of another scale, are told apart by that: no heart has moved.
    poses = rigid if hint else with_motion(views, rigid, options)
    motions = [
        (pose.motion_mm, pose.motion is not None, before.after)
        for pose, before in zip(poses, rigid, strict=True)
    ]
    findings += check_motion(views, motions, options.quality)
    for one in asked(views, rigid, options):
        ids = views[one.partner].view_id, views[one.view].view_id
        turn = one.turn_deg, one.turned, one.turn_gain
        scale = one.scale, one.scaled, one.scale_gain
        lone = one.uncovered_mm
        findings += check_asked(ids, one.given, turn, scale, options.quality, lone)
    moves = [(pose.offset_mm, pose.turn_deg) for pose in poses]
    findings += check_poses(views, moves, options.quality)
    findings += _unfinished(views, poses) + _marked_apart(views, poses)
    after, partners = [pose.after for pose in poses], [pose.partner for pose in poses]
    refusal = ""
    try:
        with with_hint(hint):
            findings += check_consistency(views, after, options.quality, partners)
    except RefusedError as error:
        refusal = str(error)
    by_width = any(new.kind != old.kind for new, old in zip(views, given, strict=True))
    return Registered(
        views=tuple(_placed(view, pose) for view, pose in zip(views, poses, strict=True)),
        poses=poses,
        findings=tuple(findings),
        hint=hint,
        refusal=refusal or (_two_contradictions(poses) if by_width else ""),
        drawn=_drawn(angiograms, options),
    )


def _drawn(angiograms: Sequence[Angiogram], options: RunOptions) -> str:
    """Name what the user drew: where views contradict each other, it is doubted before them."""
    what = [f"strokes in view {one.view_id}" for one in angiograms
            if one.erased is not None or one.painted is not None]  # fmt: skip
    marks = {
        "landmarks": options.landmarks, "marks of one vessel": options.same_branch,
        "inlets": options.ostia,
    }  # fmt: skip
    what += [f"{name} ({len(given)})" for name, given in marks.items() if given]
    return f"the user's {', '.join(what)}" if what else ""


def _placed(view: VesselImage, pose: Pose) -> VesselImage:
    """Build the correction in; nobody asks any more what was taken for a device."""
    return posed(view if view.kept is None else dataclasses.replace(view, kept=None), pose)


def _two_contradictions(poses: Sequence[Pose]) -> str:
    """Say why views are refused whose contrasts contradict each other, and outlines do, too.

    Of pictures of two patients outlines may agree by chance, but hardly where vessels turn and end.
    """
    moved = max(pose.motion_mm for pose in poses)
    if moved < LEAST_CONTRADICTION_MM:
        return ""
    return (
        "the views contradict each other: in the contrasts of their vessels, and by "
        f"{moved:.1f} mm (root mean square) in where these turn and end; different patients, "
        "frames, angles or pixel sizes?"
    )


def _marked_apart(views: Sequence[VesselImage], poses: Sequence[Pose]) -> list[str]:
    """Name views whose landmarks their correction does not bring together."""
    return [
        f"view {view.view_id}: rays through the landmarks still pass each other by "
        f"{pose.landmark_after_mm:.1f} mm (root mean square): do they mark the same places?"
        for view, pose in zip(views, poses, strict=True)
        if (pose.landmark_after_mm or 0.0) > LANDMARKS_APART_MM
    ]


def _unfinished(views: Sequence[VesselImage], poses: Sequence[Pose]) -> list[str]:
    """Name views whose correction was cut short; one that stays where it was told has none."""
    return [
        f"view {view.view_id}: the estimate of where it stands was stopped at its cap of steps, "
        "not at its best: the tree may be displaced or bent"
        for view, pose in zip(views, poses, strict=True)
        if not pose.converged and pose.theta.any()
    ]
