"""The default refinement: a tree of tubes fitted to the pictures, its sigma and its volume."""

from gcar_deploy.tubes.choice import CloseCall
from gcar_deploy.tubes.gauss_newton import Ending
from gcar_deploy.tubes.model import Footprint, footprint, tubes_of
from gcar_deploy.tubes.refine import Refined, refine, refined_volume

__all__ = [
    "CloseCall",
    "Ending",
    "Footprint",
    "Refined",
    "footprint",
    "refine",
    "refined_volume",
    "tubes_of",
]
