"""Models: read, guarded and checked before anything of them runs; every network alike."""

from gcar_deploy.models.card import model_card
from gcar_deploy.models.golden import Golden, check_golden, golden_path
from gcar_deploy.models.session import Session
from gcar_deploy.models.spec import Kind, ModelFile, check_graph, read_model

__all__ = [
    "Golden",
    "Kind",
    "ModelFile",
    "Session",
    "check_golden",
    "check_graph",
    "golden_path",
    "model_card",
    "read_model",
]
