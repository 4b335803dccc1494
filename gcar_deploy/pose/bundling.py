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
from gcar_deploy.tree.tree import Tree

#: a tree and its views' poses are fitted to each other at most so often
ROUNDS = 2
#: a tree that lies this near to all lines, in pixels, is left alone (16 generated scenes, moved and
#: corrected by profiles: 0.2 .. 0.5); else the distance must fall to ``MIN_GAIN`` of what it was
LEAST_PX = 0.6
#: makes a tree of views that have their corrections built in
TreeOf: TypeAlias = Callable[[Sequence[VesselImage]], Tree]
#: a view that moves by less than this between rounds has arrived, mm; and within a round, by less
#: than this a step, mm or deg
ARRIVED_MM, ARRIVED_STEP = 0.5, 0.05


def bundled(
    views: Sequence[VesselImage],
    poses: Sequence[Pose],
    tree_of: TreeOf,
    options: RunOptions,
) -> tuple[Pose, ...]:
    """Fit tree and poses to each other in turn.

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
    than lines do), or where the adjustment does not bring the tree clearly nearer to the pictures
    """
    told = [view.carm for view in views]
    first = poses = tuple(poses)
    if len(views) < 3 or not options.pose.enabled or all(view.calibrated for view in views):
        return poses
    if not any(pose.theta.any() for pose in poses):
        return poses
    marks = landmark_pixels(options.landmarks, told)
    for _ in range(ROUNDS):
        theta = np.stack([pose.theta for pose in poses])
        tree = tree_of([posed(view, pose) for view, pose in zip(views, poses, strict=True)])
        found = adjust(tree, views, told, theta, marks)
        near_mm = LEAST_PX * max(carm.pixel_at_isocenter_mm for carm in told)
        if found.before_mm < near_mm or found.after_mm >= MIN_GAIN * found.before_mm:
            if poses is not first:  # the last round stands
                poses = tuple(dataclasses.replace(pose, converged=True) for pose in poses)
            break
        arrived = bool(np.abs(found.theta - theta)[:, :3].max() < ARRIVED_MM)
        still = arrived and found.moving < ARRIVED_STEP
        poses = tuple(
            dataclasses.replace(pose.at(t), converged=still)
            for pose, t in zip(poses, found.theta, strict=True)
        )
        if arrived:
            break
    return first if poses == first else poses_between(views, options, poses)


def posed(view: VesselImage, pose: Pose) -> VesselImage:
    """Return the view with its correction built in, and with the motion undone."""
    if pose.motion is not None:
        view = pose.motion.undone(view)
    carm = pose.applied(view.carm)
    return view if carm is view.carm else dataclasses.replace(view, carm=carm)
