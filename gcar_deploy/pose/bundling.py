"""Three or more views that do not agree as they are told: their poses from the tree they show."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from gcar_deploy.config import RunOptions
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.pose.agreement import poses_between
from gcar_deploy.pose.bundle_adjustment import adjust
from gcar_deploy.pose.landmarks import landmark_pixels
from gcar_deploy.pose.pairwise import Pose
from gcar_deploy.pose.profile_fit import MIN_GAIN
from gcar_deploy.quality import unexplained
from gcar_deploy.tree.tree import Tree

#: a tree and its views' poses are fitted to each other at most so often
ROUNDS = 4
#: makes a tree of views that have their corrections built in
TreeOf: TypeAlias = Callable[[Sequence[VesselImage]], Tree]
#: a view that moves by less than this between rounds has arrived, mm; and within a round, by less
#: than this a step, mm or deg
ARRIVED_MM, ARRIVED_STEP = 0.15, 0.05


def bundled(
    views: Sequence[VesselImage],
    poses: Sequence[Pose],
    tree_of: TreeOf,
    options: RunOptions,
) -> tuple[Pose, ...]:
    """Fit tree and poses to each other in turn.

    Mass profiles have many local minima. So the views stay as they are told where the tree that
    they show so explains as much of their lines.

    Parameters
    ----------
    views : V vessel images as they are told
    poses : their corrections by mass profiles (``poses_between``)
    tree_of : makes a tree of views that have their corrections built in
    options : RunOptions

    Returns
    -------
    V poses with what the profiles say of them: as given with fewer than three views, where no
    view had to be moved, where all pictures are calibrated (their profiles place them more exactly
    than lines do), or where the adjustment does not bring the tree clearly nearer to the pictures;
    zero where the views stay
    """
    told = [view.carm for view in views]
    first = poses = tuple(poses)
    if len(views) < 3 or not options.pose.enabled or all(view.calibrated for view in views):
        return poses
    if not any(pose.theta.any() for pose in poses):
        return poses
    marks = landmark_pixels(options.landmarks, told)
    placed = _placed(views, poses)
    tree = tree_of(placed)
    # Marks are a person's word for where the views stand.
    if not len(marks):
        stays = _explained(tree_of(views), views, options)
        if stays >= _explained(tree, placed, options):
            still = [dataclasses.replace(p.at(np.zeros(5)), converged=True) for p in poses]
            return poses_between(views, options, still)
    last_mm = np.inf
    for round_ in range(ROUNDS):
        if round_:
            tree = tree_of(_placed(views, poses))
        theta = np.stack([pose.theta for pose in poses])
        found = adjust(tree, views, told, theta, marks)
        if found.after_mm >= MIN_GAIN * found.before_mm:
            if poses is not first:  # the last round stands
                poses = tuple(dataclasses.replace(pose, converged=True) for pose in poses)
            break
        arrived = bool(np.abs(found.theta - theta)[:, :3].max() < ARRIVED_MM)
        # Along what the lines do not see, views go on moving while the tree comes no nearer.
        settled = (arrived and found.moving < ARRIVED_STEP) or (
            found.before_mm >= MIN_GAIN * last_mm
        )
        last_mm = found.before_mm
        poses = tuple(
            dataclasses.replace(pose.at(t), converged=settled)
            for pose, t in zip(poses, found.theta, strict=True)
        )
        if arrived:
            break
    return first if poses == first else poses_between(views, options, poses)


def _placed(views: Sequence[VesselImage], poses: Sequence[Pose]) -> list[VesselImage]:
    return [posed(view, pose) for view, pose in zip(views, poses, strict=True)]


def _explained(tree: Tree, placed: Sequence[VesselImage], options: RunOptions) -> float:
    """Share of the views' lines near the reprojected tree, 0 .. 1, on average over the views."""
    shares = []
    for view in placed:
        left = unexplained(tree, view, options.quality)
        shares.append(1.0 - left.sum() / max(int((view.skeleton & view.valid).sum()), 1))
    return float(np.mean(shares))


def posed(view: VesselImage, pose: Pose) -> VesselImage:
    """Return the view with its correction built in, and with the motion undone."""
    if pose.motion is not None:
        view = pose.motion.undone(view)
    carm = pose.applied(view.carm)
    return view if carm is view.carm else dataclasses.replace(view, carm=carm)
