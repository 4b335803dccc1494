"""Where the views stand to each other: pairwise, joint, from the tree, from landmarks."""

from gcar_deploy.pose.landmarks import landmark_pixels, marked_places
from gcar_deploy.pose.pairwise import Pose
from gcar_deploy.pose.registration import Registered, register

__all__ = ["Pose", "Registered", "landmark_pixels", "marked_places", "register"]
